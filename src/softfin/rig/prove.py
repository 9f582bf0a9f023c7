"""Proof that the drive stops by itself if softfin dies, tested with the motor powered and saved in
the rig record.

Nothing else stops a fin if its program is killed or hangs. Whether the drive stops by itself
depends on its settings and firmware, so a rig with a file must not move its fin before this proof.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from softfin.core.errors import DeviceError, RigError, SoftfinError
from softfin.core.json_object import describe_changes
from softfin.rig.config import RigConfig
from softfin.rig.device import Drive
from softfin.rig.drive_safety import PausedError
from softfin.rig.record import StopProof, date_and_time, load_record, save_record
from softfin.storage.paths import typed_path


def prove_stop(config: RigConfig, drive: Drive) -> StopProof:
    """Withhold heartbeats from the open drive, while its motor is powered at standstill, and save
    the proof in the rig record.

    Raises PausedError if the test is not valid. If the drive does not stop by itself, removes any
    earlier proof and raises DeviceError.
    """
    with removed_on_failure(config):
        faulted_after_s = drive.prove_stop()
    proof = StopProof(
        date=date_and_time(),
        drive=drive.identity,
        heartbeat_s=config.drive.heartbeat_s,
        host_node=config.drive.host,
        faulted_after_s=round(faulted_after_s, 4),
    )
    record = load_record(config.file)
    save_record(config.file, record.model_copy(update={"stop_proof": proof}))
    return proof


@contextmanager
def removed_on_failure(config: RigConfig) -> Iterator[None]:
    """Remove an earlier proof that the drive stops by itself if a test fails in this context."""
    try:
        yield
    except PausedError:
        raise
    except SoftfinError as error:
        record = load_record(config.file)
        try:
            save_record(config.file, record.model_copy(update={"stop_proof": None}))
        except SoftfinError as failure:
            problem = f"{error}; AND the earlier proof could not be removed: {failure}"
            raise DeviceError(problem) from error
        raise


def check_proof(config: RigConfig, drive: Drive) -> StopProof | None:
    """Return the proof for the open drive and these settings; raises RigError if there is no proof.

    Returns None for a rig that was built in Python without a file, because it has no record.
    """
    if config.file is None:
        return None
    proof = load_record(config.file).stop_proof
    problem = "no proof yet that its drive stops if softfin dies"
    if proof is not None:
        # A drive that has changed, or has other settings, may react differently.
        then = proof.drive | {"heartbeat_s": proof.heartbeat_s, "host_node": proof.host_node}
        own = config.drive
        now = drive.identity | {"heartbeat_s": own.heartbeat_s, "host_node": own.host}
        changes = describe_changes(then, now)
        if not changes:
            return proof
        problem = f"the proof that its drive stops is no longer valid ({changes})"
    raise RigError(f"rig of {config.fin}: {problem}; run: {proving_command(config.file)}")


def proving_command(file: Path, options: str = "--prove") -> str:
    """Return the command for testing whether a rig drive stops by itself."""
    return f"softfin rig check --rig {typed_path(file)} {options} --arm"
