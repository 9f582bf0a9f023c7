"""The page in a browser: what it shows of a recording."""

import math
import threading

import numpy as np
import pytest

from softfin.core.power import describe_powers, mean_powers
from softfin.rig.monitor import web
from softfin.rig.monitor.follow import Follower
from softfin.storage.bag.zero import zero_event
from tests.browser import Browser
from tests.rig.monitor.bags import Recording


@pytest.fixture(scope="module")
def browser():
    with Browser() as browser:
        yield browser


@pytest.fixture
def show(browser, tmp_path):
    """Function that opens the page of a recording and waits until it shows its rows."""
    servers = []

    def show(recording):
        bag = tmp_path / "run.mcap"
        bag.write_bytes(recording.bytes)
        served = web.Server(Follower(bag), 0)
        servers.append(served)
        threading.Thread(target=served.serve_forever, args=(0.05,), daemon=True).start()
        browser.complaints.clear()
        browser.visit(served.address)
        browser.run(
            "new Promise((done) => (function look() { element('counts').textContent === '' ? "
            "setTimeout(look, 20) : done(); })())"
        )
        return browser

    yield show
    browser.visit("about:blank")
    for served in servers:
        served.shutdown()
        served.server_close()
    assert browser.complaints == []


def row(browser, name):
    """Texts of a row in the table of values."""
    texts = browser.run(
        "[...element('values').rows].map((row) => [...row.cells].map((cell) => cell.textContent))"
    )
    return next(cells for head, *cells in texts if head == name)


def beat(tick):
    """A fin that gives back energy in part of each stroke."""
    phase = 2 * math.pi * tick / 50
    return 3 * math.sin(phase), 0.8 * math.sin(phase + 1) + 0.0005 * tick


def test_the_live_power_is_the_mean_of_torque_times_velocity_and_its_force_is_the_mean(show):
    recording = Recording().chunk(150, force=(5.0, 5.0), load=(0.0, 0.1))
    recording.chunk(350, force=(2.3, -1.0), event=zero_event((0.3, -0.25)), load=beat)
    page = show(recording)
    loads = np.array([beat(tick) for tick in range(300, 500)])
    power_w = loads.prod(axis=1).mean()
    assert loads.prod(axis=1).min() < -0.1
    assert page.run("latest(averaged(rows.power, 1))") == pytest.approx(power_w, rel=1e-6)
    now, mean, _ = row(page, "power [W]")
    assert now == f"{math.prod(beat(499)):.2f}".replace("-", "\N{MINUS SIGN}")
    assert mean == f"{power_w:.2f}"
    powers = mean_powers(math.hypot(2.0, -0.75), [power_w, math.nan])
    assert page.run("element('power').textContent") == describe_powers(powers)


def test_a_fin_that_gives_power_back_has_no_force_per_watt(show):
    page = show(Recording().chunk(300, load=(1.0, -0.5)))
    assert page.run("element('power').textContent") == (
        "mean power \N{MINUS SIGN}0.50 W mechanical; - N/W, \N{MINUS SIGN}30 J per minute"
    )


@pytest.mark.parametrize(("ticks", "torque"), [(300, 0.0), (150, 0.25)], ids=["torque", "window"])
def test_the_power_is_empty_without_a_torque_and_before_the_first_window(show, ticks, torque):
    page = show(Recording().chunk(ticks, load=(1.0, torque)))
    assert row(page, "power [W]")[1] == "\N{EN DASH}"
    assert page.run("element('power').textContent") == ""
