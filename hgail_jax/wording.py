"""How what is printed says things."""


def counted(number: int, noun: str, plural: str | None = None) -> str:
    """Returns so many of a thing in words; its `plural` is the noun with an s unless another is given.

    >>> counted(1, "seed"), counted(8, "seed"), counted(1, "policy", "policies"), counted(0, "policy", "policies")
    ('1 seed', '8 seeds', '1 policy', '0 policies')
    """
    return f"{number} {noun if number == 1 else plural or f'{noun}s'}"
