"""A recording watched while it is made: its file is followed, on this computer or another; the loop never notices."""

from softfin.deployment.monitor.follow import Follower
from softfin.deployment.monitor.summary import Summary

__all__ = ["Follower", "Summary"]
