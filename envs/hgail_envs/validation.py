"""Checks of values from outside: each raises a ValueError that names the value and the values allowed."""

import json
from collections.abc import Callable, Iterable
from typing import Any

import jax
import numpy as np

MOST = 1_000_000
"""The largest count that is accepted: more of anything exceeds any machine's memory."""
MOST_SEED = 2**31 - 1
"""The largest seed, also the largest of JAX's default integers."""

_SMALLEST, _LARGEST = float(np.finfo(np.float32).smallest_subnormal), float(np.finfo(np.float32).max)


def check_count(name: str, value: Any, least: int = 1, most: int = MOST) -> None:
    """Refuses values other than integers from `least` to `most`.

    >>> check_count("rounds", 2.5, least=0)
    Traceback (most recent call last):
    ValueError: rounds is 2.5; it must be an integer
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ValueError(f"{name} is {value!r}; it must be an integer")
    if value < least:
        raise ValueError(f"{name} is {value}; it must be at least {least}")
    if value > most:
        raise ValueError(f"{name} is {value}; it must be at most {most}")


def check_fraction(name: str, value: Any) -> None:
    """Refuses numbers, or arrays of them, that are not from 0 to 1; lets tracers pass."""
    _check_range(name, value, 0.0, 1.0, "from 0 to 1")


def check_positive(name: str, value: Any) -> None:
    """Refuses numbers, or arrays of them, that are not positive and finite in single precision; lets tracers pass."""
    _check_range(name, value, _SMALLEST, _LARGEST, "positive and finite")


def check_not_negative(name: str, value: Any) -> None:
    """Refuses numbers, or arrays of them, that are negative or not finite; lets tracers pass."""
    _check_range(name, value, 0.0, _LARGEST, "at least 0 and finite")


def check_choice(name: str, value: Any, choices: dict[str, int]) -> None:
    """Refuses numbers, or arrays of them, that are not values of `choices`; lets tracers pass."""
    if not _all(value, lambda array: np.isin(array, list(choices.values()))):
        known = ", ".join(f"{number} ({choice})" for choice, number in choices.items())
        raise ValueError(f"{name} is {value!r}; it must be one of {known}")


def check_name(name: str, value: Any, choices: Iterable[str]) -> None:
    """Refuses values other than `choices`."""
    known = list(choices)
    if value not in known:
        raise ValueError(f"{name} is {value!r}; choose from {', '.join(known)}")


def plain_number(value: Any) -> Any:
    """Returns NumPy's scalars as Python's numbers, which JSON can hold; anything else as it is.

    >>> plain_number(np.int64(8)), plain_number((1, np.float32(0.5))), plain_number("8")
    (8, (1, 0.5), '8')
    """
    if isinstance(value, tuple):
        return tuple(map(plain_number, value))
    return value.item() if isinstance(value, np.generic) else value


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """Returns a count with its noun; the plural is the noun with an s unless another is given.

    >>> counted(1, "seed"), counted(8, "seed"), counted(0, "policy", "policies")
    ('1 seed', '8 seeds', '0 policies')
    """
    return f"{number} {noun if number == 1 else plural or f'{noun}s'}"


def parse_option(owner: str, option: str) -> tuple[str, bool | int | float | str]:
    """Splits an option that is written as name=value, its value a number, true, false or a word.

    >>> parse_option("task", "gain=0.5"), parse_option("task", "achieved=at-rest")
    (('gain', 0.5), ('achieved', 'at-rest'))
    >>> parse_option("robot", "gain")
    Traceback (most recent call last):
    ValueError: robot option 'gain' is not name=value with a number, true, false or a word
    """
    name, _, text = option.partition("=")
    try:
        value = json.loads(text)
    except json.JSONDecodeError:
        value = text if text.replace("-", "_").isidentifier() else None
    if not isinstance(value, bool | int | float | str):
        raise ValueError(f"{owner} option {option!r} is not name=value with a number, true, false or a word")
    return name, value


def _check_range(name: str, value: Any, least: float, most: float, allowed: str) -> None:
    if not _all(value, lambda array: (array >= least) & (array <= most)):
        raise ValueError(f"{name} is {value!r}; it must be {allowed}")


def _all(value: Any, test: Callable[[np.ndarray], Any]) -> bool:
    if isinstance(value, jax.core.Tracer):  # has no value yet
        return True
    try:
        array = np.asarray(value)
    except ValueError:  # a ragged list
        return False
    if array.dtype.kind not in "biuf":
        return False
    return bool(np.all(test(array.astype(np.float64))))
