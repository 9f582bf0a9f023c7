"""What is wrong with how a log's channels belong together, and with logs beside one another."""

from collections.abc import Sequence

import numpy as np

from softfin.core.quantities import AXES, PAPER_LIMITS, RATE_HZ
from softfin.data.checks.findings import Finding, Place
from softfin.data.checks.measurement import IDLE_S, Facts
from softfin.data.importing.alignment import COMMAND_LAG_MS, FORCE_LAG_MS, SHORTEST_S
from softfin.data.importing.importing import ImportConfig, composed
from softfin.data.importing.recording import NamedLog

TOLERANCE_MS = 10.0
"""A lag is told to within a tick."""

SPREAD_MS = {"command": 40.0, "force": 25.0}
"""Clocks that differ by more than this between logs are not one clock. A log of a minute tells the command's lag to
within 8 ms where the fin moves as roughly as the published nets do."""

USUAL_MS = 30.0
"""Of either lag, in a fin whose clocks agree."""

LAGGING = {"command": "command_angle", "force": "force_x, force_y"}
"""The columns that such a finding is about."""

FRAME_MARGIN = 0.1
"""By how much the correlation of another frame must be better."""

FRAME_LEAST = 0.12
"""Less than this is no fin's force in any frame; the roughest log of the published nets has 0.2."""

IDLE_SHARE = 0.3

FEW_CELLS = 0.5
"""Of the commanded angles and velocities, in a 6 x 6 grid over their own ranges."""

COVERED_STEPS = 300
"""Commands from which empty cells mean something: 36 random cells then stay empty with odds of 1 in 4000."""


def judge_one(facts: Facts, config: ImportConfig) -> list[Finding]:
    """One log's channels with one another; the ways out go on from the options that were given."""
    return [*_following(facts, config), *_axes(facts, config), *_rest(facts)]


def _following(facts: Facts, config: ImportConfig) -> list[Finding]:
    if facts.command_steps == 0 and facts.rows >= SHORTEST_S * RATE_HZ:
        sentence = f"the commanded angle is {facts.command_angle_rad[0]:.3g} rad throughout"
        way_out = "map the column of the commanded angle; a log without commands teaches none"
        return [Finding("error", "constant command", Place(facts.name, "command_angle"), sentence, way_out)]
    if facts.following < -0.3 and facts.rows >= SHORTEST_S * RATE_HZ:
        turned = "angle" if _mirrored(facts) else "command_angle"
        sentence = f"the angle goes against its command: correlation {facts.following:.2f}"
        if turned == "angle":
            sentence += ", and the force fits the mirrored angle"
        return [Finding("error", "command sign", Place(facts.name, turned), sentence, _negate(turned, config))]
    if facts.following < 0.3 and facts.rows >= SHORTEST_S * RATE_HZ:
        sentence = f"the angle hardly follows its command: correlation {facts.following:.2f} after 150 ms"
        way_out = "map other columns for angle and command_angle, or check the clocks"
        return [Finding("warning", "not following", Place(facts.name, "command_angle"), sentence, way_out)]
    return []


def _negate(channel: str, config: ImportConfig) -> str:
    names = ",".join(name for name in (*config.negate, channel) if config.negate.count(channel) == 0 or name != channel)
    return f"--negate {names}" if names else "leave --negate out"


def _mirrored(facts: Facts) -> bool:
    return facts.frames is not None and max(facts.frames, key=facts.frames.__getitem__) == "x,-y"


def _axes(facts: Facts, config: ImportConfig) -> list[Finding]:
    if facts.frames is None or (facts.following < -0.3 and _mirrored(facts)):
        return []
    best, given = max(facts.frames, key=facts.frames.__getitem__), facts.frames["x,y"]
    place = Place(facts.name, "force_x, force_y")
    if facts.frames[best] > max(given + FRAME_MARGIN, FRAME_LEAST):
        told = f"correlation with what a fin does {given:.2f} as they are, {facts.frames[best]:.2f} as {best}"
        return [
            Finding(
                "error", "force axes", place, f"axes {_turned(best)}: {told}", f"--force={composed(config.force, best)}"
            )
        ]
    if given < FRAME_LEAST:
        sentence = f"the force has little to do with the motion: correlation {given:.2f} at best"
        way_out = "check that force and angle are of one experiment, and the clocks"
        return [Finding("warning", "unexplained force", place, sentence, way_out)]
    return []


def _turned(frame: str) -> str:
    x, y = frame.split(",")
    negated = [axis for axis, term in zip(AXES, (x, y), strict=True) if term.startswith("-")]
    words = ["swapped"] if x[-1] == "y" else []
    return " and ".join(words + ([f"negated ({', '.join(negated)})"] if negated else []))


def _rest(facts: Facts) -> list[Finding]:
    findings = []
    if facts.idle > IDLE_SHARE:
        sentence = f"{facts.idle:.0%} of the time the fin rests for more than {IDLE_S:g} s: nothing is learnt from that"
        way_out = "cut rests off, or command more often"
        findings.append(Finding("warning", "at rest", Place(facts.name), sentence, way_out))
    if facts.offset_n is not None:
        for axis, offset, deviation in zip(AXES, facts.offset_n, facts.force_std_n, strict=True):
            if abs(offset) > max(0.3, 0.2 * deviation):
                sentence = f"{offset:+.2f} N on the fin at rest, beside a standard deviation of {deviation:.2f} N"
                way_out = "tare the sensor in still water before each log, or subtract this from the column"
                findings.append(
                    Finding("warning", "force offset", Place(facts.name, f"force_{axis}"), sentence, way_out)
                )
    return findings


def judge_all(facts: list[Facts], config: ImportConfig) -> list[Finding]:
    """Logs beside one another."""
    findings = [*judge_lags(facts, config), *_drift(facts), *_coverage([one for one in facts if one.part == "train"])]
    if not any(one.part == "test" for one in facts):
        way_out = "name some: --test PATTERN; or put them into a folder test"
        findings.append(Finding("note", "no test logs", Place("all logs"), "no logs to score on", way_out))
    return findings


def judge_lags(facts: list[Facts], config: ImportConfig) -> list[Finding]:
    """Clocks that lie where no fin and drive put them, and clocks that differ between logs."""
    findings = []
    for name, plausible in (("command", COMMAND_LAG_MS), ("force", FORCE_LAG_MS)):
        lags = [(one.command_lag if name == "command" else one.force_lag, one.name) for one in facts]
        known = [(lag.milliseconds, log) for lag, log in lags if lag is not None]
        if not known:
            continue
        usual = float(np.median([lag for lag, _ in known]))
        wrong = [one for one in known if _implausible(one[0], plausible)]
        far = [one for one in known if abs(one[0] - usual) > SPREAD_MS[name]]
        # A log is wrong where all are, or where it stands out; a rough one may tell its lag badly.
        stopping = wrong if _implausible(usual, plausible) else [one for one in wrong if one in far]
        findings += [_lag(name, lag, log, plausible, config) for lag, log in stopping]
        if rest := [one for one in far if one not in stopping]:
            lag, log = max(rest, key=lambda one: abs(one[0] - usual))
            sentence = f"the {name}'s lag is {lag:.0f} ms, where the median of {len(known)} logs is {usual:.0f} ms"
            remedy = f"import these logs by themselves with --{name}-lag, or leave them out"
            place = Place(log, LAGGING[name])
            findings.append(Finding("warning", "lags differ", place, sentence, remedy, tuple(log for _, log in rest)))
    return findings


def _implausible(lag: float, plausible: tuple[float, float]) -> bool:
    return not plausible[0] - TOLERANCE_MS <= lag <= plausible[1] + TOLERANCE_MS


def _lag(name: str, lag: float, log: str, plausible: tuple[float, float], config: ImportConfig) -> Finding:
    first, second = ("the angle", "its command") if name == "command" else ("the force", "the angle")
    told = f"{first} follows {second} by {lag:.0f} ms" if lag >= 0 else f"{first} is {-lag:.0f} ms ahead of {second}"
    # A command that is stamped late makes the angle early, a force that is stamped late is late itself.
    late = lag - USUAL_MS if name == "force" else USUAL_MS - lag
    late += config.command_lag_ms if name == "command" else config.force_lag_ms
    sentence = f"{told}; plausible are {plausible[0]:.0f} to {plausible[1]:.0f} ms: a clock is off"
    remedy = f"--{name}-lag {10 * round(late / 10):d} moves the {name} so that about {USUAL_MS:.0f} ms remain"
    return Finding("error", f"{name} lag", Place(log, LAGGING[name]), sentence, remedy)


def _drift(facts: list[Facts]) -> list[Finding]:
    findings = []
    for index, axis in enumerate(AXES):
        offsets = [(one.offset_n[index], one.name) for one in facts if one.offset_n is not None]
        if len(offsets) < 2:
            continue
        (low, _), (high, log) = min(offsets), max(offsets)
        deviation = float(np.median([one.force_std_n[index] for one in facts]))
        if high - low > max(0.6, 0.35 * deviation):
            sentence = f"the force at rest differs by {high - low:.2f} N between logs ({low:+.2f} .. {high:+.2f} N)"
            way_out = "tare the sensor in still water before each log"
            findings.append(Finding("warning", "force drift", Place(log, f"force_{axis}"), sentence, way_out))
    return findings


def _coverage(facts: list[Facts]) -> list[Finding]:
    if not facts:
        return []
    low = min(one.command_angle_rad[0] for one in facts)
    high = max(one.command_angle_rad[1] for one in facts)
    whole = PAPER_LIMITS.angle_max - PAPER_LIMITS.angle_min
    if high - low < whole * 2 / 3:
        sentence = (
            f"commanded angles span {low:.2f} .. {high:.2f} rad: a surrogate knows nothing beyond, nor controllers"
        )
        return [Finding("note", "coverage", Place("all logs", "command_angle"), sentence, "command wider angles")]
    return []


def covered(logs: Sequence[NamedLog]) -> list[Finding]:
    """Whether the commands of all logs to learn from fill their own ranges."""
    commands = [one.log.command for one in logs if one.part == "train"]
    pairs = [np.stack([command.angle, command.velocity], axis=1).astype(np.float64) for command in commands]
    steps = [pair[1:][(np.diff(pair, axis=0) != 0).any(axis=1)] for pair in pairs]
    if sum(map(len, steps)) < COVERED_STEPS:
        return []
    angle, velocity = np.concatenate(steps).T
    counts, _, _ = np.histogram2d(angle, velocity, bins=6)
    filled = float((counts > 0).mean())
    if filled >= FEW_CELLS:
        return []
    sentence = f"{filled:.0%} of the commands' range of angle and velocity, in 36 cells, has been commanded at all"
    way_out = "excite with random angles and velocities: softfin collect shows how"
    return [Finding("warning", "coverage", Place("all logs", "command_angle"), sentence, way_out)]
