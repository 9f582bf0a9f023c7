import pytest

from softfin.core.errors import ConfigurationError
from softfin.surrogate import StreamingConfig


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("burn_in=400", r"burn_in must be less than ticks = 400"),
        ("free_running=[0.8, 0.2]", r"two parts of the training in order, such as 0\.2, 0\.8"),
        ("free_running=[0.5, 1.2]", r"two parts of the training in order"),
        ("members=0", r"members = 0: Input should be greater than 0"),
        ("force.mirors=true", r"did you mean 'mirror'"),
    ],
)
def test_what_cannot_be_fitted_is_refused(change, words):
    with pytest.raises(ConfigurationError, match=words):
        StreamingConfig().changed([change])
