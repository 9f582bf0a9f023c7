"""One program at a time uses a device; within this process, and between processes."""

import os
import signal
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

from softfin.core.errors import DeviceError, RigError
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.rig import EmulatedRig, kept_rig, rigs, write_simulated
from softfin.rig import lock as locks
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig.config import load_rig
from softfin.rig.devices.dynamixel.drive import Dynamixel
from softfin.rig.devices.lines.config import LinesConfig
from softfin.rig.devices.lines.sensor import lines_sensor
from softfin.rig.lock import DeviceLock
from softfin.rig.rig import Rig, zero_force
from softfin.tank import Tank
from tests.patience import HANG_S, wait_until
from tests.rig.devices.dynamixel.bench import servo_config
from tests.rig.rigs import config_of, patient
from tests.rig.simple_fin import SimpleFin

ROOT = Path(__file__).parents[2]

HOLDER = """
import sys
from pathlib import Path
from softfin.rig.computer import COMPUTER, Computer
from softfin.rig import lock
lock.LOCK_FOLDER = Path(sys.argv[1])
lock.DeviceLock("drive", "can0", 1).acquire(COMPUTER)
print("locked", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(locks, "LOCK_FOLDER", tmp_path)
    tmp_path.chmod(0o1777)
    return tmp_path


@contextmanager
def another_program(folder):
    """A process that has locked drive 1 of can0."""
    environment = os.environ | {"PYTHONPATH": f"{ROOT / 'src'}:{ROOT}"}
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=environment,
    )
    try:
        assert process.stdout.readline() == "locked\n"
        yield process
    finally:
        process.kill()
        process.communicate(timeout=HANG_S)


def test_a_device_of_another_program_is_refused_with_its_number_until_that_program_is_killed(
    folder,
):
    lock = DeviceLock("drive 1", "can0", 1)
    with another_program(folder) as other:
        expected = (
            r"^drive 1: in use by another program \(process "
            rf"{other.pid}\); close that program first$"
        )
        with pytest.raises(RigError, match=expected):
            lock.acquire(COMPUTER)
        other.kill()
        other.wait(HANG_S)
        lock.acquire(COMPUTER)
        with pytest.raises(RigError, match=str(os.getpid())):
            DeviceLock("drive 1", "can0", 1).acquire(COMPUTER)
        lock.release()


def test_a_lock_works_within_a_process_and_other_devices_are_free(folder):
    first = DeviceLock("drive 1", "can0", 1)
    second = DeviceLock("drive 1", "can0", 1)
    first.acquire(COMPUTER)
    first.acquire(COMPUTER)
    DeviceLock("drive 2", "can0", 2).acquire(COMPUTER)
    with pytest.raises(RigError, match="in use"):
        second.acquire(COMPUTER)
    first.release()
    first.release()
    second.acquire(COMPUTER)
    second.release()


def test_no_name_of_a_device_leads_out_of_the_folder(folder):
    lock = DeviceLock("drive", "slcan", "/dev/../../tmp/tty@0", 1)
    lock.acquire(COMPUTER)
    (file,) = folder.iterdir()
    assert file.name == "softfin-slcan_dev_.._.._tmp_tty_0_1"
    lock.release()


def test_a_device_that_cannot_be_locked_is_used_with_a_note(folder):
    # A folder in place of the file, which no user can open for writing.
    (folder / "softfin-can0_1").mkdir()
    lock = DeviceLock("drive 1", "can0", 1)
    lock.acquire(COMPUTER)
    assert lock.note.startswith("drive 1: cannot be locked (")
    assert lock.note.endswith("make sure that no other program uses it")
    lock.release()


def test_a_link_in_place_of_the_lock_is_not_followed(folder):
    precious = folder / "precious"
    precious.write_text("kept")
    (folder / "softfin-can0_1").symlink_to(precious)
    lock = DeviceLock("drive 1", "can0", 1)
    lock.acquire(COMPUTER)
    assert lock.note is not None
    assert precious.read_text() == "kept"


@pytest.mark.parametrize("kind", ["missing", "of root only"])
def test_a_lock_folder_that_some_users_cannot_write_to_is_not_used(tmp_path, monkeypatch, kind):
    """Root could write to it, but would then not see the locks of other users."""
    official = tmp_path / "lock"
    if kind == "of root only":
        official.mkdir(mode=0o755)
    shared = tmp_path / "shared"
    shared.mkdir()
    monkeypatch.setattr(locks, "LOCK_FOLDER", official)
    monkeypatch.setattr(locks, "SHARED_FOLDER", shared)
    # A folder for this user only, as on macOS or with TMPDIR.
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    lock = DeviceLock("drive 1", "can0", 1)
    lock.acquire(COMPUTER)
    assert lock.note is None
    assert [file.name for file in shared.iterdir()] == ["softfin-can0_1"]
    lock.release()


def test_the_program_that_holds_a_lock_is_asked_to_exit(folder):
    lock = DeviceLock("drive 1", "can0", 1)
    with another_program(folder) as other:
        assert lock.take_over(COMPUTER)
        assert other.wait(HANG_S) == -signal.SIGTERM
    lock.release()


def test_a_program_may_take_two_seconds_to_stop_its_fin(folder):
    holder = DeviceLock("drive 1", "can0", 1)
    holder.acquire(COMPUTER)

    class Fast(Computer):
        now = 0.0

        def __call__(self):
            return self.now

        def sleep(self, seconds):
            self.now += seconds
            if self.now > 2.0:
                holder.release()

    lock = DeviceLock("drive 1", "can0", 1)
    assert lock.take_over(Fast())
    lock.release()


def test_a_port_has_one_lock_whatever_its_name(folder):
    port = folder / "ttyUSB0"
    port.touch()
    link = folder / "by-id"
    link.symlink_to(port)
    for made in (
        lambda name: Dynamixel(servo_config(port=str(name))),
        lambda name: lines_sensor(
            LinesConfig.build(
                {
                    "port": str(name),
                    "columns": ("force_x", "force_y"),
                    "rate_hz": 100.0,
                    "filter_delay_s": 0.0,
                    "frame": "x,y",
                }
            )
        ),
    ):
        first, second = (made(name).device_lock for name in (port, link))
        first.acquire(COMPUTER)
        with pytest.raises(RigError, match="in use"):
            second.acquire(COMPUTER)
        first.release()


def test_a_program_that_does_not_end_keeps_its_lock(folder, monkeypatch):
    monkeypatch.setattr(locks, "TAKE_OVER_S", 0.05)
    with another_program(folder) as other:
        # A stopped process does not handle signals.
        other.send_signal(signal.SIGSTOP)
        wait_until(lambda: "State:\tT" in Path(f"/proc/{other.pid}/status").read_text())
        lock = DeviceLock("drive 1", "can0", 1)
        assert not lock.take_over(COMPUTER)
        assert other.poll() is None


def test_an_unrelated_program_with_the_id_in_the_lock_file_is_not_stopped(folder, monkeypatch):
    monkeypatch.setattr(locks, "TAKE_OVER_S", 0.05)
    holder = DeviceLock("drive 1", "can0", 1)
    holder.acquire(COMPUTER)
    (file,) = folder.iterdir()
    innocent = subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=-1)
    try:
        file.write_text(f"{innocent.pid}\n")
        assert not DeviceLock("drive 1", "can0", 1).take_over(COMPUTER)
        assert innocent.poll() is None
    finally:
        holder.release()
        innocent.communicate(timeout=HANG_S)


def test_a_device_in_simulated_time_is_not_locked(folder):
    DeviceLock("drive 1", "can0", 1).acquire(SimulatedClock())
    assert list(folder.iterdir()) == []


@pytest.mark.real_time
def test_a_second_program_is_refused_by_the_drive_before_it_asks_the_sensor(folder, monkeypatch):
    with patient(), EmulatedRig(fin=SimpleFin(), clock=COMPUTER) as behind:
        first = Rig(config_of(behind))
        first.open()
        second = Rig(config_of(behind))
        with monkeypatch.context() as patches:
            patches.setattr(
                "softfin.rig.devices.axia80.sensor.read_settings",
                lambda *_: pytest.fail("asked the sensor"),
            )
            with pytest.raises(RigError, match=r"drive 1 on CAN bus virtual .*: in use"):
                second.open()
            with pytest.raises(RigError, match=r"force sensor 127.0.0.1: in use"):
                zero_force(second)
        first.close()
        second.open()
        second.close()


@pytest.mark.real_time
def test_a_rig_that_fails_to_open_leaves_no_lock(folder):
    with patient(), EmulatedRig(fin=SimpleFin(), clock=COMPUTER) as behind:
        without_page = Rig(config_of(behind, sensor=behind.values()["sensor"] | {"http_port": 1}))
        with pytest.raises(DeviceError, match="cannot read the web page of the force sensor"):
            without_page.open()
        rig = Rig(config_of(behind))
        rig.open()
        rig.close()


def test_two_programs_cannot_use_one_emulated_rig_at_once(folder):
    file = folder / "rig.yaml"
    write_simulated(file, Tank(), {}, seed=0)
    first = kept_rig(load_rig(file))
    # Another process has no rigs yet.
    del rigs[file.resolve()]
    with pytest.raises(RigError, match=r"rig.yaml: emulated rig: in use by another program"):
        kept_rig(load_rig(file))
    first.close()
    kept_rig(load_rig(file)).close()
    del rigs[file.resolve()]
