import pytest

from seal_gym.core import errors
from seal_gym.core.errors import SealGymError, require

CLASSES = [v for v in vars(errors).values() if isinstance(v, type)]


@pytest.mark.parametrize("cls", CLASSES)
def test_one_base_catches_all(cls):
    assert issubclass(cls, SealGymError)


@pytest.mark.parametrize("name", ["ConfigError", "SeamError", "ActionError"])
def test_bad_input_is_a_value_error_too(name):
    assert issubclass(getattr(errors, name), ValueError)


@pytest.mark.parametrize("name", ["RenderError", "PhysicsError"])
def test_failures_at_run_time_are_runtime_errors_too(name):
    assert issubclass(getattr(errors, name), RuntimeError)


def test_require():
    require(True, "not shown")
    with pytest.raises(errors.ConfigError, match=r"^value = 3$"):
        require(False, "value = 3")
    with pytest.raises(errors.SeamError):
        require(False, "", errors.SeamError)
