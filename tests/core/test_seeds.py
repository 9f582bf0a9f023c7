import pytest

from softfin.core.errors import ConfigurationError
from softfin.core.seeds import check_seed


@pytest.mark.parametrize("seed", [-1, 2**31])
def test_a_seed_that_some_generator_does_not_accept_is_refused(seed):
    check_seed(0)
    check_seed(2**31 - 1)
    with pytest.raises(ConfigurationError, match=f"--seed {seed}: "):
        check_seed(seed)
