"""Set-points of an emulated EPOS2 in profile position mode (CiA 402): one is under way, one more may wait; pure."""

NEW_SETPOINT, AT_ONCE, RELATIVE, HALT = 1 << 4, 1 << 5, 1 << 6, 1 << 8
"""Bits of the controlword."""


class Setpoints:
    """Of one stay in operation enabled; in counts."""

    def __init__(self) -> None:
        self.goal: int | None = None
        """Where the profile leads to; None before the first set-point."""
        self.waiting: int | None = None
        """What follows when the goal is reached."""
        self._accepted = False

    @property
    def acknowledged(self) -> bool:
        """Bit 12 of the statusword: the set-point was taken, or no other one can be."""
        return self._accepted or self.waiting is not None

    def control(self, word: int, before: int, target: int, demand: int) -> bool:
        """A controlword; whether the profile begins now. `demand` is where the profile is, `target` the object's."""
        begins = bool(before & ~word & HALT) and self.goal is not None
        if not word & NEW_SETPOINT:
            self._accepted = False
        elif not before & NEW_SETPOINT and (word & AT_ONCE or self.waiting is None):
            self._accepted = True
            last = next((each for each in (self.waiting, self.goal) if each is not None), demand)
            new = target + (last if word & RELATIVE else 0)
            if word & AT_ONCE or self.is_reached(demand):
                self.goal, self.waiting, begins = new, None, True
            else:
                self.waiting = new
        return begins and not word & HALT

    def follow_on(self, demand: int) -> bool:
        """Whether the set-point that waited begins now."""
        if self.waiting is None or not self.is_reached(demand):
            return False
        self.goal, self.waiting = self.waiting, None
        return True

    def is_reached(self, demand: int) -> bool:
        """Whether the profile has ended: what a drive whose position window is off, as delivered, looks at."""
        return self.goal is None or self.goal == demand
