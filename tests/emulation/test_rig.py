import socket

from softfin.emulation.rig import EmulatedRig, write_rig, write_simulated
from softfin.rig.computer import COMPUTER
from softfin.rig.config import load_rig
from softfin.tank import Tank
from tests.patience import HANG_S
from tests.rig.simple_fin import SimpleFin


def test_it_writes_a_file_that_another_process_can_use_as_it_is(tmp_path):
    with EmulatedRig(fin=SimpleFin(), clock=COMPUTER) as emulated:
        write_rig(tmp_path / "rig.yaml", emulated.values(), "An emulated rig")
        config = load_rig(tmp_path / "rig.yaml")
        socket.create_connection(
            (config.bus.options["host"], config.bus.options["port"]), timeout=HANG_S
        ).close()
        assert str(config.bus.options["port"]) in emulated.description()
        assert config.sensor.rdt_port == emulated.sensor.rdt_port


def test_its_limits_are_the_tanks(tmp_path):
    tank = Tank()
    write_simulated(tmp_path / "rig.yaml", tank, {}, seed=0)
    drive = load_rig(tmp_path / "rig.yaml").drive
    assert (drive.angle_min_rad, drive.fastest_rad_s) == (
        tank.limits.angle_min,
        tank.limits.velocity_max,
    )


def test_it_closes_any_number_of_times_and_frees_its_ports():
    emulated = EmulatedRig(fin=SimpleFin(), clock=COMPUTER)
    port = emulated.server.port
    for _ in range(3):
        emulated.close()
    with socket.create_server(("127.0.0.1", port)):
        pass
