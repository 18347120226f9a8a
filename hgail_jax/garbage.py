"""Python's search for garbage: a fifth of the time where many objects are made and nearly all of them stay."""

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def no_search() -> Iterator[None]:
    """Has no garbage searched for within the block; afterwards it is searched for as before."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
