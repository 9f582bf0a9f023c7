"""A bag of what a session does, from before the fin moves until after it stands."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from softfin.core.errors import RunError, SafetyStop
from softfin.rig.session import Session
from softfin.storage.bag.writer import BagRecorder


@contextmanager
def recording(session: Session, path: Path) -> Iterator[BagRecorder]:
    """A bag of everything that the session does meanwhile; one there that was cut off is kept under another name."""
    if path.exists():
        names = (path.with_name(f"{path.stem}.cut-{number}{path.suffix}") for number in count(1))
        path.rename(next(name for name in names if not name.exists()))
    recorder = BagRecorder(path, clock=session.pace.clock)
    session.recorder = recorder
    try:
        yield recorder
    except BaseException as error:
        session.machine.stop()
        if not isinstance(error, SafetyStop):
            recorder.event(session.pace.clock(), f"ended by {type(error).__name__}: {error}")
        raise
    finally:
        session.recorder = None
        recorder.close()
    if recorder.failure is not None:
        raise RunError(recorder.failure)
