"""A fin whose wrench the test sets."""

from softfin.emulation.fin import FinMotion


class StillFin:
    def __init__(self, *wrench):
        self.wrench = tuple(map(float, wrench)) or (0.0,) * 6

    def move(self, angle, velocity):
        pass

    def halt(self):
        pass

    def coast(self):
        pass

    def now(self):
        return FinMotion(0.0, 0.0, 0.0, 0.0, self.wrench)
