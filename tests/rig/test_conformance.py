import pytest

from softfin.core.errors import RigError
from softfin.rig.machine import Target
from tests.rig.conformance import check_machine
from tests.rig.machines import FreeFin, Hours


def check(machine_type=FreeFin):
    machine = machine_type(Hours())
    check_machine(machine)
    return machine


def test_a_machine_that_meets_the_contract_passes_and_is_closed():
    machine = check()
    assert machine.calls.count("open") == 2
    assert machine.calls[-1] == "close"
    assert not machine.enabled


class MovesUnasked(FreeFin):
    def open(self):
        super().open()
        self.enabled = True
        self._target = Target(1.0, 1.0)


class CreepsWhenEnabled(FreeFin):
    def enable(self):
        super().enable()
        self._target = Target(1.0, 1.0)


class Lame(FreeFin):
    def command(self, target):
        self.calls.append("command")


class DeafToStop(FreeFin):
    def stop(self):
        if "command" not in self.calls:
            super().stop()


class StopsInTheLoopOnly(FreeFin):
    def stop(self):
        import threading

        if threading.current_thread() is threading.main_thread():
            super().stop()


class TimeGoesBack(FreeFin):
    def read(self):
        sample = super().read()
        self.reads = getattr(self, "reads", 0) + 1
        return sample._replace(time=sample.time - 0.05 * (self.reads % 7 == 0))


class Frozen(FreeFin):
    def read(self):
        self.first = getattr(self, "first", None) or super().read()
        return self.first


class NotANumber(FreeFin):
    def read(self):
        return super().read()._replace(velocity=float("nan"))


class Wordy(FreeFin):
    def read(self):
        return {"angle": 0.0}


class Slow(FreeFin):
    def read(self):
        self.clock.sleep(0.05)
        return super().read()


class InAFault(FreeFin):
    def read(self):
        return (
            super()
            .read()
            ._replace(complaints=("drive fault 0x3220, under-voltage: check the supply",))
        )


@pytest.mark.parametrize(
    ("machine", "words"),
    [
        (MovesUnasked, "moved by .* before it was enabled"),
        (CreepsWhenEnabled, "moved by .* when it was enabled and not commanded"),
        (Lame, "went 0.000 rad after 1 s"),
        (DeafToStop, "moved by .* after stop"),
        (StopsInTheLoopOnly, "moved by .* after stop"),
        (TimeGoesBack, "time went back"),
        (Frozen, "time.* ago|stand still"),
        (NotANumber, "not finite"),
        (Wordy, "read returns dict"),
        (Slow, "read takes 50 ms"),
        (InAFault, "0x3220"),
    ],
)
def test_each_breach_of_the_contract_is_told(machine, words):
    with pytest.raises(RigError, match=words):
        check(machine)


def test_what_is_no_machine_is_told_what_it_lacks():
    with pytest.raises(RigError, match="object: has no close, command, "):
        check_machine(object())
