"""A recording watched while it is made: its file is followed, on this computer or another; the loop never notices."""

from softfin.rig.monitor.follow import Follower
from softfin.rig.monitor.summary import Summary

__all__ = ["Follower", "Summary"]
