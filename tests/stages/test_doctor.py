"""What `softfin doctor` says of this computer, and of one that is arranged for the test."""

import contextlib
import sys
from pathlib import Path

import pytest

from softfin.core.errors import RunError
from softfin.installation import EXTRAS
from softfin.rig.device import CheckResult
from softfin.stages import doctor


def results() -> dict[str, CheckResult]:
    """Every result; a check that failed is an error after the last one."""
    given = {}
    with contextlib.suppress(RunError):
        for result in doctor.doctor():
            given[result.what] = result
    return given


def test_a_check_that_failed_is_an_error_after_the_last_one(monkeypatch):
    monkeypatch.setattr(doctor, "extra_requirements", lambda extra: ["no-such-thing"])
    with pytest.raises(RunError, match="failed: packages"):
        list(doctor.doctor())


@pytest.fixture
def net(tmp_path, monkeypatch):
    """Network interfaces as Linux lists them: a loopback, and what a test adds."""
    monkeypatch.setattr(doctor, "INTERFACES", tmp_path / "net")

    def add(name: str, kind: int, flags: int) -> None:
        folder = tmp_path / "net" / name
        folder.mkdir(parents=True)
        (folder / "type").write_text(f"{kind}\n")
        (folder / "flags").write_text(f"{flags:#x}\n")

    add("lo", 772, 0x9)
    return add


def test_every_part_has_a_line_and_none_names_the_users_home(monkeypatch):
    monkeypatch.setenv("HOME", str(Path(sys.prefix).parent))
    found = results()
    assert list(found) == [
        "softfin",
        "Python",
        "system",
        "packages",
        *(f"[{extra}]" for extra in EXTRAS),
        "JAX",
        "compile cache",
        "disk",
        "CAN",
        "serial ports",
    ]
    for result in found.values():
        assert "\n" not in result.text
        assert str(Path(sys.prefix).parent) not in result.text
    assert found["Python"].text.partition(", ")[2].startswith("~/")
    assert found["JAX"].text.startswith("cpu:0")
    assert "numpy " in found["packages"].text


def test_can_interfaces_are_listed_with_what_brings_one_up(net):
    assert results()["CAN"].text.startswith("no SocketCAN interface")
    net("can0", 280, 0x40081)
    assert results()["CAN"] == CheckResult("CAN", "well", "can0 up")
    net("can1", 280, 0x40080)
    assert results()["CAN"] == CheckResult(
        "CAN", "note", "can0 up, can1 down; run: sudo ip link set NAME up type can bitrate 1000000"
    )


def test_the_folder_of_compiled_programs_is_checked(tmp_path, monkeypatch):
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("SOFTFIN_CACHE", str(tmp_path / "programs"))
    assert results()["compile cache"] == CheckResult(
        "compile cache", "well", str(tmp_path / "programs")
    )
    monkeypatch.setenv("SOFTFIN_CACHE", "off")
    assert results()["compile cache"].state == "note"
    (tmp_path / "file").touch()
    monkeypatch.setenv("SOFTFIN_CACHE", str(tmp_path / "file" / "programs"))
    assert results()["compile cache"].state == "wrong"


def test_a_serial_port_that_may_not_be_used_is_a_note(tmp_path, monkeypatch):
    monkeypatch.setattr(doctor, "PORTS_FOLDER", tmp_path)
    assert results()["serial ports"].text.startswith("none on USB")
    (tmp_path / "ttyUSB0").touch()
    assert results()["serial ports"] == CheckResult(
        "serial ports", "well", str(tmp_path / "ttyUSB0")
    )
    monkeypatch.setattr("os.access", lambda path, mode: False)
    assert "usermod -aG dialout" in results()["serial ports"].text


def test_an_extra_that_is_not_there_says_how_it_is_added(monkeypatch):
    wanted = {"learn": ["numpy", "no-such-thing"]}
    monkeypatch.setattr(doctor, "extra_requirements", lambda extra: wanted.get(extra, []))
    assert results()["[learn]"] == CheckResult(
        "[learn]", "note", 'lacks no-such-thing; if you need it: pip install "softfin[learn]"'
    )


def test_what_jax_raises_is_a_line(monkeypatch):
    def broken() -> None:
        raise RuntimeError("no\ndevice")

    monkeypatch.setattr("jax.devices", broken)
    assert results()["JAX"].state == "wrong"
    assert "no device found (no device)" in results()["JAX"].text


def test_without_jax_it_is_not_examined(monkeypatch):
    monkeypatch.setattr(doctor, "installed_version", lambda name: None if name == "jax" else "1")
    assert "JAX" not in results()
    assert results()["[learn]"].text.startswith("lacks jax; if you need it")
