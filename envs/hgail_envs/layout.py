"""Layout of a vector: which numbers of an observation, a goal or an action are which quantity."""

import functools
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

METRES = "m"
"""Unit of positions and distances."""
FLAG = "0 or 1"
"""Unit of a number that says yes or no."""
FRAMES = {
    "world": "of the scene: x ahead of the robot, y to its left, z up, origin on the floor; also the axes of relative"
    " positions and of velocities",
    "hand": "of the hand: each finger moves along its own axis, and 0 is closed",
}
"""Meaning of the frames."""

_AXES = ("x", "y", "z")


class Quantity(NamedTuple):
    """Neighbouring numbers that are measured together, such as a position."""

    name: str
    """Unique in its layout."""
    size: int = 1
    """Count of its numbers; up to three are called x, y and z, more are numbered from 0."""
    unit: str = ""
    """`METRES`, `FLAG`, `"rad"` and so on; empty if it is not known."""
    frame: str = ""
    """A name in `FRAMES`; empty for a number that has none."""
    when: str = ""
    """Of a past quantity, e.g. `"1 step earlier"`."""

    @property
    def title(self) -> str:
        """Name, and when."""
        return f"{self.name}, {self.when}" if self.when else self.name

    @property
    def numbers(self) -> "tuple[Quantity, ...]":
        """Each number as a quantity.

        >>> position("cube position").numbers[2].name
        'cube position z'
        """
        parts = _AXES if self.size <= len(_AXES) else tuple(map(str, range(self.size)))
        names = [self.name] if self.size == 1 else [f"{self.name} {part}" for part in parts[: self.size]]
        return tuple(self._replace(name=name, size=1) for name in names)


def position(name: str) -> Quantity:
    """Returns a position, or a difference of two, metres along the world's axes."""
    return Quantity(name, 3, METRES, "world")


def flag(name: str) -> Quantity:
    """Returns a number that is 0 or 1."""
    return Quantity(name, 1, FLAG)


class Layout:
    """Quantities of a vector, in their order; two of the same name are a ValueError.

    >>> goal = Layout(position("target position"), flag("hand holds the cube"))
    >>> goal.size, goal["target position"], goal["hand holds the cube"]
    (4, slice(0, 3, None), 3)
    """

    def __init__(self, *quantities: Quantity) -> None:
        self.quantities = quantities
        self._places: dict[str, slice | int] = {}
        first = 0
        for quantity in quantities:
            if quantity.title in self._places:
                raise ValueError(f"a layout has {quantity.title!r} twice; names of quantities must differ")
            self._places[quantity.title] = first if quantity.size == 1 else slice(first, first + quantity.size)
            first += quantity.size
        self.size = first
        """Count of the numbers."""

    @classmethod
    def numbered(cls, kind: str, size: int) -> "Layout":
        """Returns the layout of a vector that nobody described: `"goal 0"`, `"goal 1"` and so on."""
        return cls(*(Quantity(f"{kind} {index}") for index in range(size)))

    def __iter__(self) -> Iterator[Quantity]:
        return iter(self.quantities)

    def __add__(self, other: "Layout") -> "Layout":
        return Layout(*self.quantities, *other.quantities)

    def __getitem__(self, name: str) -> slice | int:
        """Returns where a quantity is: the index of a single number, the slice of several."""
        return self._places[name]

    def span(self, first: str, last: str) -> slice:
        """Returns where quantities are that follow one another, from the first to the last of them.

        >>> Layout(position("place"), flag("held"), flag("left")).span("held", "left")
        slice(3, 5, None)
        """
        start, stop = (np.atleast_1d(np.arange(self.size)[self[name]]) for name in (first, last))
        return slice(int(start[0]), int(stop[-1]) + 1)

    @property
    def numbers(self) -> tuple[Quantity, ...]:
        """Each number as a quantity, `size` of them."""
        return tuple(number for quantity in self for number in quantity.numbers)

    def _where(self, condition: Callable[[str], bool]) -> slice | np.ndarray:
        """Returns where the numbers are whose unit meets a condition."""
        places = np.flatnonzero([condition(number.unit) for number in self.numbers])
        if places.size and places.size == places[-1] - places[0] + 1:
            return slice(int(places[0]), int(places[-1]) + 1)
        return places

    def is_near(self, one: jax.Array, other: jax.Array, distance: float) -> jax.Array:
        """Returns whether vectors, `[..., size]`, have equal flags and are else within a distance: booleans `[...]`."""
        flags = self._where(lambda unit: unit == FLAG)
        if not isinstance(flags, slice) and not len(flags):
            return jnp.linalg.norm(one - other, axis=-1) <= distance
        others = self._where(lambda unit: unit != FLAG)
        near = jnp.linalg.norm(one[..., others] - other[..., others], axis=-1) <= distance
        return near & jnp.all(one[..., flags] == other[..., flags], axis=-1)

    def metres(self, vector: jax.Array) -> jax.Array:
        """Returns the metres of a vector, or if there are none all but flags, or all of one that is not `[size]`."""
        units = {number.unit for number in self.numbers}
        if vector.shape != (self.size,) or units <= {FLAG}:
            return vector
        return vector[self._where(lambda unit: unit == METRES if METRES in units else unit != FLAG)]

    def split(self, vector: Any) -> dict[str, Any]:
        """Returns the values of all quantities of a vector, `[..., size]`, by their names; the inverse of `join`."""
        return {name: vector[..., place] for name, place in self._places.items()}

    def readers(self, functions: Mapping[str, Callable[[Mapping[str, Any]], Any]]) -> dict[str, Callable[[Any], Any]]:
        """Returns functions of vectors, `[..., size]`, that call the given ones with the vectors' values by name."""
        return {name: functools.partial(self._read, function) for name, function in functions.items()}

    def _read(self, function: Callable[[Mapping[str, Any]], Any], vector: Any) -> Any:
        return function(self.split(vector))

    def join(self, values: Mapping[str, Any], xp: Any = jnp) -> Any:
        """Returns the vector, `[size]`, of values by the names of their quantities, `[quantity.size]` or `[]`.

        `xp` is `jax.numpy` or `numpy`. A value that is missing, unknown or of another size is a ValueError.
        """
        if values.keys() != self._places.keys():
            wrong = min(values.keys() ^ self._places.keys())
            fault = "given but not in the layout" if wrong in values else "in the layout but not given"
            raise ValueError(f"values do not fit the layout: {wrong!r} is {fault}")
        arrays = (xp.asarray(values[quantity.title]) for quantity in self)
        parts = [xp.reshape(array.astype(np.float32) if array.dtype == bool else array, -1) for array in arrays]
        for quantity, part in zip(self, parts, strict=True):
            if part.size != quantity.size:
                raise ValueError(f"{quantity.title!r} has {part.size} numbers; its layout says {quantity.size}")
        return xp.concatenate(parts)


def past(features: Layout, action: Layout, history: int, known_delay: int) -> Layout:
    """Returns the layout of the past that a randomised task shows before its features; see `RandomizedEnv`.

    First come `known_delay` actions that have not taken effect, then `history` past actions and observations, both the
    newest first.
    """
    pending = [
        quantity._replace(when=f"sent {_steps(back)} ago and on its way")
        for back in range(1, known_delay + 1)
        for quantity in (flag("whether there is an action"), *action)
    ]
    earlier = [
        quantity._replace(when=f"{_steps(back)} earlier")
        for back in range(1, history + 1)
        for quantity in (*action, *features)
    ]
    return Layout(*pending, *earlier)


def _steps(count: int) -> str:
    return f"{count} step{'s' if count > 1 else ''}"


class HasLayouts:
    """Sizes and layouts of a task's vectors: a class declares one or the other, as class attributes."""

    feature_size: int
    """Numbers in the part of the observation that does not depend on the goal."""
    goal_size: int
    """Numbers in a goal."""
    action_size: int
    """Numbers in an action; each is clipped to [-1, 1]."""
    features_layout: Layout = Layout()
    """Of the features; if a class sets `feature_size` alone, they are numbered, and likewise below."""
    goal_layout: Layout = Layout()
    """Of a goal; at the goal its flags must be equal, and distances are of its metres."""
    action_layout: Layout = Layout()
    """Of an action."""
    seen_layout: ClassVar[Layout | None] = None
    """Of the features within an observation, if `goal_observation` changes their meaning."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for kind, layout_name in _LAYOUTS.items():
            size, layout = vars(cls).get(f"{kind}_size"), vars(cls).get(layout_name)
            if layout is not None:
                if size not in (None, layout.size):
                    raise ValueError(
                        f"{cls.__name__}.{kind}_size is {size}; its {layout_name} has {layout.size} numbers"
                    )
                setattr(cls, f"{kind}_size", layout.size)
            elif isinstance(size, int):
                setattr(cls, layout_name, Layout.numbered(kind, size))

    @classmethod
    def features_with(cls, **options: Any) -> Layout:
        """Returns the layout of the features under options of the class; by default any have `features_layout`."""
        return cls.features_layout


_LAYOUTS = {"feature": "features_layout", "goal": "goal_layout", "action": "action_layout"}
