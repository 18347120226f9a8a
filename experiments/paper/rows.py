"""The rows of a study's files, from the results of its trials."""

from typing import Any

import numpy as np

from experiments.paper.study import Setting, Study
from hgail_jax.trainer.statistics import Estimate, confidence_interval, interquartile_mean, probability_of_improvement

_FINAL = {
    "success": "success_rate",
    "achieved": "achieved_rate",
    "success_l1": "success_rate_l1",
    "distance_l1": "distance_l1",
    "distance_l2": "distance_l2",
}


def table_rows(task: str, study: Study, results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the rows of a table, one per setting, of what their trials ended with.

    `seconds` is a setting's share of the time that its program trained for. A row is `older` if another one of the
    table was made later by another commit.
    """
    rows = []
    for setting, result, made_by in zip(study.settings, results, _made_by(results), strict=True):
        final, program = result["final"], result["program"]
        success, distance = np.array(final["success"]), np.array(final["distance_l1"])
        paper_success, paper_distance = setting.paper.get(task, ("", ""))
        rows.append(
            {
                **_names(task, setting),
                "seeds": len(success),
                "first_seed": result["identity"]["seeds"][0],
                "success_rate": float(success.mean()),
                "success_ci95": _number(confidence_interval(success)),
                **_estimate("success_iqm", interquartile_mean(success)),
                "worst_seed": float(success.min()),
                "achieved_rate": float(np.mean(final["achieved"])),
                "success_rate_l1": float(np.mean(final["success_l1"])),
                "distance_l1": float(distance.mean()),
                "distance_l1_ci95": _number(confidence_interval(distance)),
                **_estimate("distance_l1_iqm", interquartile_mean(distance)),
                "distance_l2": float(np.mean(final["distance_l2"])),
                "diverged_seeds": result["diverged_seeds"],
                "env_steps_per_seed": result["env_steps"][-1],
                "seconds": round(program["seconds"]["train"] / program["settings"], 3),
                "paper_success": paper_success,
                "paper_distance_l1": paper_distance,
                **made_by,
                "command": result["made_by"]["command"],
                "versions": _versions(result["made_by"]["versions"]),
            }
        )
    return rows


def seed_rows(task: str, study: Study, results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns what each seed of each setting ended with."""
    return [
        {
            **_names(task, setting),
            "seed": seed,
            **{column: result["final"][name][index] for name, column in _FINAL.items()},
            "env_steps": result["env_steps"][-1],
            **made_by,
        }
        for setting, result, made_by in zip(study.settings, results, _made_by(results), strict=True)
        for index, seed in enumerate(result["identity"]["seeds"])
    ]


def improvement_rows(task: str, study: Study, results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns how probably a seed of each setting has a higher success rate than one of each setting after it."""
    of_settings = list(zip(study.settings, results, strict=True))
    return [
        {
            "task": task,
            "setting": setting.label,
            "than": other.label,
            **_estimate("probability", _improvement(result, of_other)),
        }
        for index, (setting, result) in enumerate(of_settings)
        for other, of_other in of_settings[index + 1 :]
    ]


def improvement_over_reference(study: Study, results: list[dict[str, Any]]) -> list[Estimate | None]:
    """Returns how probably each setting's seeds are better than those that the study compares it with, if any."""
    by_label = {setting.label: result for setting, result in zip(study.settings, results, strict=True)}
    references = [study.compared_with(setting) for setting in study.settings]
    return [
        None if reference is None else _improvement(result, by_label[reference.label])
        for reference, result in zip(references, results, strict=True)
    ]


def curve_rows(task: str, study: Study, results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns the rows of a figure's data, one per setting, seed and round that was evaluated."""
    return [
        {
            **_names(task, setting),
            "seed": seed,
            "round": number,
            "env_steps": steps,
            "success": success[index],
            "distance": distance[index],
            "commit": made_by["commit"],
        }
        for setting, result, made_by in zip(study.settings, results, _made_by(results), strict=True)
        for number, steps, success, distance in zip(
            *(result[name] for name in ("rounds", "env_steps", "success", "distance_l1")), strict=True
        )
        for index, seed in enumerate(result["identity"]["seeds"])
    ]


def _names(task: str, setting: Setting) -> dict[str, str]:
    return {"task": task, "method": setting.method, "setting": setting.name, "panel": setting.panel}


def _made_by(results: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Returns commit and device of each result, and whether it is older: of another commit than the newest one."""
    made = [result["made_by"] for result in results]
    newest = max(made, key=lambda made_by: made_by["date"])["commit"]
    return [
        {
            "commit": made_by["commit"],
            "older": "older" if made_by["commit"] != newest else "",
            "device": made_by["device"]["kind"],
        }
        for made_by in made
    ]


def _versions(versions: dict[str, str | None]) -> str:
    return "; ".join(f"{name} {version}" for name, version in versions.items() if version is not None)


def _improvement(result: dict[str, Any], of_other: dict[str, Any]) -> Estimate:
    return probability_of_improvement(*(np.array(one["final"]["success"]) for one in (result, of_other)))


def _estimate(name: str, estimate: Estimate) -> dict[str, float | None]:
    return {name: estimate.value, f"{name}_low": _number(estimate.low), f"{name}_high": _number(estimate.high)}


def _number(value: np.ndarray | float) -> float | None:
    return float(value) if np.isfinite(value) else None
