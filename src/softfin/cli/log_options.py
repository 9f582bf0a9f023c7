"""Options of the commands that read recordings of other software."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from softfin.core.choices import ForceUnit, TimeUnit

if TYPE_CHECKING:
    from softfin.data.importing.importing import ImportConfig


@dataclass(frozen=True, kw_only=True)
class LogOptions:
    """How recordings become logs; softfin's own need none of these."""

    columns: str | None = None
    """Which column is which channel, where its name does not say: angle=NAME,command_angle=NAME,command_velocity=NAME,
    force_x=NAME,force_y=NAME,time=NAME,velocity=NAME; - for none."""
    topics: str | None = None
    """Topics of ROS 2 bags: command=/fin/command,joint=/fin/joint_states,wrench=/fin/wrench."""
    rate: float | None = None
    """Rows per second [Hz], where no column holds the time."""
    velocity: float | None = None
    """Velocity of all commands [rad/s], where no column holds it."""
    time_unit: TimeUnit | None = None
    """Unit of the column of time (by default the one in its name, else s)."""
    angles: str | None = None
    """Unit of angles and their velocities: rad, mrad, deg, turn, or of each, as angle=deg,velocity=rpm (by default
    the ones in the names, else rad)."""
    force_unit: ForceUnit | None = None
    """Unit of the columns of force (by default the one in their names, else N)."""
    force: str | None = None
    """Axes of the recording that are +x (thrust) and +y, such as y,-x. Write --force=-y,x if it begins with -."""
    negate: str | None = None
    """Channels of the wrong sign, such as command_angle."""
    command_lag: float | None = None
    """Time by which commands were stamped later than the angle [ms]."""
    force_lag: float | None = None
    """Time by which forces were stamped later than the angle [ms]."""
    rows_per_log: int | None = None
    """Rows of each log, where one file holds several, end to end."""
    test: str | None = None
    """Pattern of the files that are test logs (names that begin with test, and what lies in a folder test)."""
    gap: float | None = None
    """Longest gap that is bridged [s]; longer ones split a log (0.05)."""
    shortest: float | None = None
    """Shortest piece between gaps that is kept [s] (2)."""

    def import_config(self) -> "ImportConfig":
        """The options that were given, over the defaults."""
        from softfin.data.importing.importing import ImportConfig

        given = {
            "columns": self.columns,
            "topics": self.topics,
            "rate_hz": self.rate,
            "velocity_rad_s": self.velocity,
            "time_unit": self.time_unit,
            "angles": self.angles,
            "force_unit": self.force_unit,
            "force": self.force,
            "negate": self.negate,
            "command_lag_ms": self.command_lag,
            "force_lag_ms": self.force_lag,
            "rows_per_log": self.rows_per_log,
            "test": self.test,
            "gap_s": self.gap,
            "shortest_s": self.shortest,
        }
        return ImportConfig.build({name: value for name, value in given.items() if value is not None}, "options")


def columns_read(columns: Mapping[str, str]) -> str:
    """Lines that tell how columns with names of their own were read, by the first log of each way."""
    return "".join(f"{log}: {text}\n" for log, text in columns.items())
