import json

import numpy as np

from softfin.data.checks.inspection import inspect
from softfin.data.checks.report import inspection_figure, write_inspection
from tests.data.faulty import cut, log_of, named, tank_logs, to_columns


def faulty():
    logs = []
    for log in tank_logs(2):
        columns = to_columns(log)
        columns["force_x_n"][3000] += 40
        columns["force_y_n"] *= -1
        logs.append(log_of(columns))
    return named(*logs)


def axes_of(logs):
    return inspection_figure(inspect(logs), logs).get_axes()


def test_the_trace_is_about_the_gravest_issue_that_has_a_row():
    logs = faulty()
    angle, force, *_ = axes_of(logs)
    assert "around row 3000: spikes" in angle.get_title(loc="left")
    shown = {line.get_label(): line for line in force.get_lines()}
    time, x = shown["force x"].get_data()
    assert len(time) == 1000
    assert x[np.flatnonzero(np.isclose(time, 30.01))[0]] == logs[0].log.reading.force[3000, 0]
    assert shown["spikes"].get_xdata()[0] == 30.01
    assert force.get_ylabel() == "force [N]"


def test_lags_and_axes_of_all_logs_are_drawn():
    logs = faulty()
    inspection = inspect(logs)
    *_, lags, frames = inspection_figure(inspection, logs).get_axes()
    drawn = [line.get_ydata() for line in lags.get_lines()]
    np.testing.assert_allclose(drawn[1], [one.force_lag_ms for one in inspection.logs])
    widths = {
        label.get_text(): bar.get_width()
        for label, bar in zip(frames.get_yticklabels(), frames.patches, strict=True)
    }
    assert max(widths, key=widths.__getitem__) == "x,-y"


def test_the_folder_holds_json_and_the_figure(tmp_path):
    logs = named(*tank_logs(2))
    written = write_inspection(inspect(logs), logs, tmp_path / "i", {"source": "here"})
    assert json.loads((tmp_path / "i" / "inspection.json").read_text()) == json.loads(
        json.dumps(written)
    )
    assert written["issues"] == []
    assert (tmp_path / "i" / "inspection.png").stat().st_size > 10_000


def test_further_channels_have_ranges_in_the_summary():
    first, second = (cut(log, 0, 2000) for log in tank_logs(2))
    ramp = np.linspace(-1, 3, 2000, dtype=np.float32)
    first = first._replace(channels={"torque_nm": ramp, "price [$]": 0 * ramp})
    second = second._replace(channels={"torque_nm": 2 * ramp})
    logs = named(first, second)
    inspection = inspect(logs)
    assert inspection.summary()["channels"] == {
        "torque_nm": (-2.0, 6.0),
        "price [$]": (0.0, 0.0),
    }
