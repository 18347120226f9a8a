"""Draws the paper's Algorithms 1 and 2, and the site's icon: `python -m docs._generate.diagrams` writes them."""

from collections.abc import Iterable
from pathlib import Path

IMAGES = Path(__file__).parent.parent / "images"

_TEAL, _ORANGE, _GREY, _INK = "#00796b", "#e64a19", "#90a4ae", "#263238"


def _svg(width: int, height: int, parts: Iterable[str]) -> str:
    arrow = f'<path d="M0 0L8 4L0 8z" fill="{_INK}"/>'
    marker = f'<marker id="tip" markerWidth="8" markerHeight="8" refX="7" refY="4" orient="auto">{arrow}</marker>'
    start = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    lines = [f'{start} font-family="Helvetica, Arial, sans-serif" font-size="14">', f"<defs>{marker}</defs>"]
    return "\n".join([*lines, *parts, "</svg>"]) + "\n"


def _text(x: float, y: float, words: str, color: str = _INK, anchor: str = "middle", bold: bool = False) -> str:
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x:g}" y="{y:g}" fill="{color}" text-anchor="{anchor}"{weight}>{words}</text>'


def _box(x: float, y: float, width: float, lines: list[str], color: str) -> list[str]:
    """A box whose first line is its title; `x` and `y` are its upper left corner."""
    height = 14 + 19 * len(lines)
    shape = f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{height}" rx="8" fill="white"'
    parts = [f'{shape} stroke="{color}" stroke-width="2"/>']
    for number, words in enumerate(lines):
        first = number == 0
        parts.append(_text(x + width / 2, y + 23 + 19 * number, words, color if first else _INK, bold=first))
    return parts


def _arrow(path: str, color: str = _INK, dashed: bool = False) -> str:
    dashes = ' stroke-dasharray="5 4"' if dashed else ""
    return f'<path d="{path}" fill="none" stroke="{color}" stroke-width="1.8" marker-end="url(#tip)"{dashes}/>'


def relabelling() -> str:
    """Algorithm 1: a step's goal becomes a position that the trajectory reached later."""
    points = [(60, 210), (150, 190), (240, 150), (330, 135), (420, 100), (510, 112), (600, 90)]
    parts = [_text(60, 30, "one trajectory, seen from the side", _GREY, "start")]
    path = " L".join(f"{x} {y}" for x, y in points)
    parts.append(f'<path d="M{path}" fill="none" stroke="{_TEAL}" stroke-width="2.5"/>')
    for number, (x, y) in enumerate(points):
        parts.append(f'<circle cx="{x}" cy="{y}" r="6" fill="{_TEAL}"/>')
        index = "T" if number == len(points) - 1 else number
        parts.append(_text(x, y + 24, f's<tspan font-size="10" dy="4">{index}</tspan>', _TEAL))
    parts.append(f'<circle cx="690" cy="200" r="9" fill="{_GREY}"/>')
    parts.append(_text(690, 228, "the goal pursued,", _GREY))
    parts.append(_text(690, 246, "never reached", _GREY))
    parts.append(_arrow("M150 180 C 200 60, 330 40, 412 90", _ORANGE))
    parts.append(_text(262, 58, "step 1: l = 4", _ORANGE))
    parts.append(_arrow("M330 125 C 390 30, 540 20, 594 80", _ORANGE))
    parts.append(_text(470, 28, "step 3: l = T", _ORANGE))
    words = "A step j is chosen with probability p_ht. Its goal becomes the position at a step l, drawn from j+1 to T."
    parts.append(_text(400, 290, words))
    parts.append(_text(400, 312, "Seen under that goal, what the robot did was right: it is an expert's sample."))
    return _svg(800, 330, parts)


def training() -> str:
    """Algorithm 2: pre-training, then rounds of policy and discriminator updates."""
    parts = [
        *_box(20, 20, 230, ["Pre-training, once", "roll out, relabel", "policy: maximum likelihood"], _GREY),
        *_box(300, 20, 220, ["Roll-out", "T steps in N environments", "goal and start per episode"], _TEAL),
        *_box(560, 20, 220, ["Relabel (Algorithm 1)", "the expert samples", "of this policy"], _ORANGE),
        *_box(300, 180, 220, ["g steps: PPO", "reward from the discriminator,", "none from the environment"], _TEAL),
        *_box(
            560,
            180,
            220,
            ["d steps: discriminator", "expert samples towards 1,", "the policy's own towards 0"],
            _ORANGE,
        ),
        *_box(20, 180, 230, ["Evaluation, each round", "mean action", "on the task's own goals"], _GREY),
        _arrow("M250 55 L294 55"),
        _arrow("M520 55 L554 55"),
        _arrow("M670 91 L670 174"),
        _arrow("M380 91 L380 174"),
        _arrow("M440 180 L440 97"),
        _text(372, 140, "trajectories", anchor="end"),
        _text(448, 140, "new policy", anchor="start"),
        _arrow("M560 215 L526 215"),
        _text(543, 300, "reward of the logit: r1 = softplus(d), r2, r3 or r4"),
        _arrow("M543 286 L543 222", _GREY, dashed=True),
        _arrow("M300 215 L256 215"),
    ]
    return _svg(800, 320, parts)


def icon() -> str:
    """A path that ends at another place than its goal."""
    parts = [
        f'<path d="M5 26 C 12 22, 14 8, 26 8" fill="none" stroke="{_TEAL}" stroke-width="4" stroke-linecap="round"/>',
        f'<circle cx="26" cy="8" r="4.5" fill="{_ORANGE}"/>',
    ]
    return _svg(32, 32, parts)


DIAGRAMS = {"algorithm1.svg": relabelling, "algorithm2.svg": training, "favicon.svg": icon}


def main() -> None:
    """Writes the pictures."""
    for name, draw in DIAGRAMS.items():
        (IMAGES / name).write_text(draw())


if __name__ == "__main__":
    main()
