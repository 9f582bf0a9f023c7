"""A bag of what a session does, from before the fin moves until after it stands."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from softfin.deployment.session import Session
from softfin.errors import RunError
from softfin.logs.bag_writer import BagRecorder


@contextmanager
def recording(session: Session, path: Path) -> Iterator[BagRecorder]:
    """A bag of everything that the session does meanwhile; one there that was cut off is kept under another name."""
    if path.exists():
        number = sum(1 for _ in path.parent.glob(f"{path.stem}.cut-*{path.suffix}")) + 1
        path.rename(path.with_name(f"{path.stem}.cut-{number}{path.suffix}"))
    recorder = BagRecorder(path)
    session.recorder = recorder
    try:
        yield recorder
    except BaseException:
        # What went wrong is told first; and it goes into the bag before that is closed.
        session.machine.stop()
        raise
    finally:
        session.recorder = None
        recorder.close()
    if recorder.failure is not None:
        raise RunError(recorder.failure)
