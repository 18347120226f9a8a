import gc

import pytest

from hgail_jax.garbage import no_search


def test_no_garbage_is_searched_for_within_the_block_and_as_before_afterwards():
    assert gc.isenabled()  # the package is imported by now
    with pytest.raises(KeyError), no_search():
        assert not gc.isenabled()
        raise KeyError
    assert gc.isenabled()
    gc.disable()
    try:
        with no_search():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
