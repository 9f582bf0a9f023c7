"""Compares the tank's chain of plates with motion capture of a silicone beam in air:
``python studies/beam.py FOLDER docs/beam.png``.

FOLDER contains six C3D recordings by Dubied et al. (2022), from the folder
``python/realbeam_experiments/Measurement_data`` of https://github.com/srl-ethz/diffPD_sim2real (MIT
licence). A clamped beam is held straight by hand, with or without a weight at its tip, and
released. Modulus and damping are fitted to the two recordings without a weight. The recordings with
a weight are then predicted.

The chain is the fin of the tank, with nothing around it. Gravity is an upward acceleration of the
mount, and the weight is mass at the end of the last plate. The beam is stocky, so the study also
adds what the thin fin of the tank lacks, shear and the rotary inertia of the sections.
"""

import struct
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.figure import Figure
from scipy.linalg import eigh
from scipy.optimize import curve_fit, least_squares, root

from softfin.core.errors import LogError
from softfin.storage.figures import BLACK, BLUE, ORANGE, new_figure, save_figure, styled
from softfin.tank import chain
from softfin.tank.chain import Moments, PerPlate, PlateMatrix, PlateMotion, PlateWrench
from softfin.tank.fin import Fin, FinConfig, FinState, Shaft, Surroundings

RATE_HZ = 100.0
"""Sampling rate of the recordings [Hz]."""

GRAVITY_M_S2 = 9.80709
"""Acceleration of gravity in the authors' scripts [m/s2]."""

PUBLISHED_MODULUS_PA = 263_824.0
"""Young's modulus that the authors fitted with differentiable FEM [Pa]."""

SIZES = {
    "length_m": 0.1,
    "root_length_m": 0.0,
    "span_m": 0.03,
    "root_thickness_m": 0.03,
    "density_kg_m3": 1070.0,
}
"""Size and density of the beam in the authors' scripts."""

PLATES = 8

STEP_S = 2e-4
"""Time step [s]. It is short because the shear correction is explicit."""

SHEAR_FACTOR = 6 / 7
"""Timoshenko's shear coefficient of a rectangular section for a Poisson's ratio of 0.5 [-] (Cowper
1966)."""

TIP_MARKERS = 3
"""Number of markers at the tip, which come first. The other markers are on the clamp."""

MARKER_HEIGHT_M = 0.007
"""Mean height of the tip markers above the axis of the beam, in the authors' scripts [m]."""

LOAD_HEIGHT_M = 0.015
"""Height of the weight above the axis of the beam [m]. The authors' scripts apply it to the upper
edge."""

WINDOW_FRAMES = 200
"""Number of frames after the first trough that are compared."""


class Case(NamedTuple):
    """An experiment that was recorded twice."""

    name: str
    """Stem of the file name."""
    load_n: float
    """Weight at the tip, in the authors' scripts [N]."""
    fem_m: Float[np.ndarray, "3 2"]
    """The authors' static FEM solution at the tip markers (along the beam, up) minus the straight
    beam [m]. They computed it with COMSOL at `PUBLISHED_MODULUS_PA`."""


CASES = (
    Case("gravity", 0.0, np.array([(1.0147, -6.774), (0.5162, -6.752), (-0.9636, -6.6913)]) / 1e3),
    Case(
        "load52",
        0.51012,
        np.array([(2.0836, -17.331), (0.4671, -16.841), (-3.4292, -16.282)]) / 1e3,
    ),
    Case(
        "load101",
        1.00062,
        np.array([(1.9954, -27.542), (-0.5983, -26.352), (-6.7193, -25.022)]) / 1e3,
    ),
)


def read_c3d(file: Path) -> Float[np.ndarray, "frames markers 3"]:
    """Read the positions of all markers from a C3D file.

    Only what motion-capture systems write today is supported: little-endian numbers, float
    positions, no analog channels.

    Raises:
        LogError: The file is of another kind, cut short, or lacks a marker in some frame.
    """
    content = file.read_bytes()
    if len(content) < 512 or content[1] != 0x50:
        raise LogError(f"{file}: not a C3D file; export the recording as C3D")
    markers, analog, first, last = struct.unpack_from("<4H", content, 2)
    scale, start = struct.unpack_from("<fH", content, 12)
    # The fourth byte of the parameter section is the number format: 84 means little-endian.
    number_format = content[(content[0] - 1) * 512 + 3]
    if number_format != 84 or scale >= 0 or analog:
        raise LogError(
            f"{file}: must contain little-endian float positions and no analog channels; export it "
            "so"
        )
    count = (last - first + 1) * markers * 4
    if len(content) < (start - 1) * 512 + 4 * count:
        raise LogError(f"{file}: ends before frame {last}; copy the file again")
    rows = np.frombuffer(content, "<f4", count, (start - 1) * 512).reshape(-1, markers, 4)
    if (rows[..., 3] < 0).any():
        raise LogError(f"{file}: a marker is missing in some frames; fill the gaps")
    return rows[..., :3].astype(float)


class Recording(NamedTuple):
    """Motion of the tip markers in the vertical plane of the beam (along the beam, up), minus their
    positions while the beam is held straight [m]."""

    path: Float[np.ndarray, "frames 3 2"]
    place: Float[np.ndarray, "3 2"]
    """Position of each marker on the straight beam, relative to the end of its axis [m]."""
    sideways_m: float
    """RMS motion of the markers out of the plane, at rest at the end [m]."""

    @property
    def trough(self) -> int:
        """Frame of the lowest position."""
        return int(self.path[..., 1].mean(axis=1).argmin())

    @property
    def rest(self) -> Float[np.ndarray, "3 2"]:
        """Mean position in the last 0.2 s [m]."""
        return np.asarray(self.path[-20:].mean(axis=0))


def load_recording(file: Path) -> Recording:
    """Load a recording. Its axes are x up, y sideways and z along the beam."""
    markers = read_c3d(file)[:, :TIP_MARKERS]
    held = markers[:10].mean(axis=0)
    place = held[:, [2, 0]] - held[:, [2, 0]].mean(axis=0) + np.array([0.0, MARKER_HEIGHT_M])
    sideways = (markers[-20:, :, 1] - held[:, 1]).mean(axis=0)
    return Recording((markers - held)[:, :, [2, 0]], place, float(np.sqrt((sideways**2).mean())))


class Beam(NamedTuple):
    """A chain of plates with a weight at its tip."""

    fin: Fin
    excess: PlateMatrix
    """Stiffness of the joints minus the stiffness with shear [N m/rad]."""
    sections: PlateMatrix
    """Map from the angles of the plates to the angles of the sections."""
    damping_s: Float[Array, ""]
    load_kg: Float[Array, ""]

    @property
    def stiffness(self) -> PlateMatrix:
        """Stiffness matrix of the plate angles, with a fixed root [N m/rad]."""
        return joint_stiffness(self.fin) - self.excess


def joint_stiffness(fin: Fin) -> PlateMatrix:
    """Return the stiffness matrix of the joints, with a fixed root [N m/rad]."""
    size = fin.stiffness.size
    bends = jnp.eye(size) - jnp.eye(size, k=-1)
    return bends.T @ (fin.stiffness[:, None] * bends)


def make_beam(config: FinConfig, load_n: float, is_stocky: bool) -> Beam:
    """Return a beam with a weight at its tip; a stocky beam has shear and rotary inertia."""
    fin = Fin(config)
    load_kg = load_n / GRAVITY_M_S2
    mass = load_kg * jnp.eye(config.plates)[-1]
    length = fin.plate_length
    zeroth, first, second, along = fin.inertia
    second += mass * (length**2 + LOAD_HEIGHT_M**2)
    sections = jnp.eye(config.plates)
    excess = jnp.zeros_like(sections)
    if is_stocky:
        area = config.span_m * config.root_thickness_m
        second += config.density_kg_m3 * area * config.root_thickness_m**2 / 12 * length
        # The plates follow the axis of the beam. The joints connect its sections, whose angles psi
        # differ from the plate angles phi by the shear: S (phi - psi) = K psi, where K is the
        # stiffness of the joints. Eliminating psi leaves the stiffness S (1 - (K + S)^-1 S).
        bending = joint_stiffness(fin)
        shear = SHEAR_FACTOR * config.youngs_modulus_pa / 3 * area * length * sections
        sections = jnp.linalg.solve(bending + shear, shear)
        excess = bending - shear @ (jnp.eye(config.plates) - sections)
    inertia = Moments(zeroth + mass, first + mass * length, second, along + mass)
    fin = eqx.tree_at(lambda fin: fin.inertia, fin, inertia)
    return Beam(fin, excess, sections, jnp.asarray(config.damping_s), jnp.asarray(load_kg))


def natural_hz(beam: Beam) -> float:
    """Return the first natural frequency of the straight beam, without damping or gravity [Hz]."""
    straight = chain.pose(jnp.zeros_like(beam.fin.stiffness), beam.fin.plate_length)
    mass = chain.momentum_matrix(straight, beam.fin.inertia)
    squares = eigh(beam.stiffness, mass, eigvals_only=True)
    return float(np.sqrt(squares[0]) / (2 * np.pi))


def load_wrench(
    beam: Beam, angles: PerPlate, rates: PerPlate, accelerations: PerPlate
) -> PlateWrench:
    """Return what the weight adds to the loads because it is above the axis of the beam.

    The inertia of the fin contains the weight as a mass on the axis. Its place is r + h n, with the
    tip r of the last plate, so its acceleration is r'' - h (d phi'' + n phi'^2).
    """
    last = jnp.eye(angles.size)[-1]
    moment = LOAD_HEIGHT_M * beam.load_kg * last
    # The acceleration of the tip along d of the last plate.
    ahead = angles[-1] - angles
    tip = beam.fin.plate_length * (jnp.sin(ahead) * accelerations - jnp.cos(ahead) * rates**2).sum()
    gravity = -GRAVITY_M_S2 * jnp.sin(angles[-1])
    outward = moment * rates**2
    return PlateWrench(
        outward,
        moment * accelerations,
        beam.fin.plate_length * outward + moment * (tip - gravity),
    )


@jax.jit
def imbalance(beam: Beam, angles: PerPlate, tip_n: Float[Array, ""]) -> PerPlate:
    """Return the generalized forces at rest with an upward force at the tip [N m]."""
    zero = jnp.zeros_like(angles)
    weight = beam.fin.inertia.times(chain.components(angles, jnp.array([0.0, -GRAVITY_M_S2])))
    last = jnp.eye(angles.size)[-1] * tip_n
    across = last * jnp.cos(angles)
    hold = PlateWrench(across, last * jnp.sin(angles), across * beam.fin.plate_length)
    wrench = jax.tree.map(
        lambda *parts: sum(parts), weight, hold, load_wrench(beam, angles, zero, zero)
    )
    pose = chain.pose(angles, beam.fin.plate_length)
    return chain.project(pose, wrench) - beam.stiffness @ angles


def marker_motion(
    beam: Beam, angles: Float[np.ndarray, "*times plates"], place: Float[np.ndarray, "3 2"]
) -> Float[np.ndarray, "*times 3 2"]:
    """Return the displacement of the tip markers (along the beam, up) from the straight beam [m]."""
    length = float(beam.fin.plate_length)
    tip = length * np.stack([(np.cos(angles) - 1).sum(-1), np.sin(angles).sum(-1)], axis=-1)
    section = (angles @ np.asarray(beam.sections)[-1])[..., None]
    along, up = place.T
    turned = np.stack(
        [
            np.cos(section) * along - np.sin(section) * up,
            np.sin(section) * along + np.cos(section) * up,
        ],
        axis=-1,
    )
    return tip[..., None, :] + turned - place


def rest_angles(beam: Beam) -> Float[np.ndarray, "plates"]:
    """Return the plate angles of the beam at rest [rad]."""
    none = jnp.asarray(0.0)
    start = np.zeros(beam.fin.stiffness.size)
    return np.asarray(root(lambda angles: imbalance(beam, angles, none), start).x)


def held_angles(
    beam: Beam, place: Float[np.ndarray, "3 2"], height_m: float
) -> Float[np.ndarray, "plates"]:
    """Return the plate angles if a vertical force at the tip holds the markers at a mean height
    [rad]."""

    def residual(unknown):
        angles = unknown[:-1]
        miss = marker_motion(beam, angles, place)[:, 1].mean() - height_m
        return np.append(imbalance(beam, angles, jnp.asarray(unknown[-1])), miss)

    return np.asarray(root(residual, np.append(rest_angles(beam), 0.0)).x[:-1])


@partial(jax.jit, static_argnames="steps")
def release(beam: Beam, angles: PerPlate, steps: int) -> FinState:
    """Release the beam from rest at `angles`; return the state after each time step."""
    zero = jnp.zeros_like(angles)
    nothing = Moments(zero, zero, zero, zero)
    clamp = Shaft(jnp.asarray(0.0), jnp.asarray(0.0), lambda load, drag: jnp.zeros_like(load))
    up = jnp.array([0.0, GRAVITY_M_S2])

    def step(state: FinState, _: None) -> tuple[FinState, FinState]:
        def loads(motion: PlateMotion) -> tuple[Moments, PlateWrench]:
            # `motion` is predicted for the middle of the step.
            rates = motion.turning
            middle = state.angles + STEP_S / 4 * (state.rates + rates)
            # The mean of two steps does not contain the ringing of stiff modes, as in the fin.
            accelerations = (state.accelerations + state.earlier) / 2
            wrench = load_wrench(beam, middle, rates, accelerations)
            shear = beam.excess @ (middle + beam.damping_s * rates)
            return nothing, wrench._replace(moment=wrench.moment + shear)

        around = Surroundings(nothing, jnp.zeros(2), loads, up)
        state, _, _ = beam.fin.step(state, clamp, around, STEP_S)
        return state, state

    start = FinState(jnp.asarray(angles), zero, zero, zero)
    states: FinState = jax.lax.scan(step, start, length=steps)[1]
    return states


def window(recording: Recording) -> Float[np.ndarray, "frames 3 2"]:
    """Return the part of a recording that is predicted."""
    first = recording.trough + 1
    return recording.path[first : first + WINDOW_FRAMES]


def predict(beam: Beam, recording: Recording) -> Float[np.ndarray, "frames 3 2"]:
    """Predict the window of a recording from the height of its first trough.

    The hand guides the beam for some 50 ms after the release, so the prediction starts where the
    beam turns, with the shape that a force at the tip would give it.
    """
    # A parabola through three frames finds the turn between the frames.
    heights = recording.path[:, :, 1].mean(axis=1)[recording.trough - 1 : recording.trough + 2]
    bow, slope, middle = np.polyfit([-1.0, 0.0, 1.0], heights, 2)
    turn = -slope / (2 * bow)
    start = held_angles(beam, recording.place, middle + slope * turn / 2)
    frames = 1 - turn + np.arange(WINDOW_FRAMES)
    steps = np.round(frames / RATE_HZ / STEP_S).astype(int)
    states = release(beam, start, round((WINDOW_FRAMES + 1) / RATE_HZ / STEP_S))
    return marker_motion(beam, np.asarray(states.angles)[steps - 1], recording.place)


class Ring(NamedTuple):
    """A damped oscillation."""

    frequency_hz: float
    decay_per_s: float


def ring(path: Float[np.ndarray, "frames 3 2"], guess_hz: float) -> Ring:
    """Fit a damped sinusoid to the mean height of the markers, with an offset that may drift."""
    times = np.arange(len(path)) / RATE_HZ
    heights = path[..., 1].mean(axis=1) * 1e3

    def model(time, offset, drift, cos, sin, decay, frequency):
        phase = 2 * np.pi * frequency * time
        swing = cos * np.cos(phase) + sin * np.sin(phase)
        return offset + drift * time + np.exp(-decay * time) * swing

    mean = heights.mean()
    start = (mean, 0.0, heights[0] - mean, 0.0, 2.0, guess_hz)
    fitted, _ = curve_fit(model, times, heights, start)
    return Ring(fitted[5], fitted[4])


def fit(recordings: Sequence[Recording], is_stocky: bool) -> FinConfig:
    """Fit modulus and damping to the heights of the markers in recordings without a weight."""

    def config(logs: Float[np.ndarray, "2"]) -> FinConfig:
        modulus, damping = np.exp(logs)
        return FinConfig(plates=PLATES, youngs_modulus_pa=modulus, damping_s=damping, **SIZES)

    def residual(logs: Float[np.ndarray, "2"]) -> Float[np.ndarray, "residuals"]:
        beam = make_beam(config(logs), 0.0, is_stocky)
        errors = [predict(beam, recording) - window(recording) for recording in recordings]
        return 1e3 * np.stack(errors)[..., 1].ravel()

    start = np.log([PUBLISHED_MODULUS_PA, 2e-3])
    return config(least_squares(residual, start, diff_step=1e-3, xtol=1e-5).x)


class Prediction(NamedTuple):
    """Prediction of one recording."""

    path: Float[np.ndarray, "frames 3 2"]
    ring: Ring
    error_m: float
    """RMS distance between the measured and predicted markers in the window."""
    rest: Float[np.ndarray, "3 2"]
    """Displacement of the markers at rest [m]."""


def evaluate(beam: Beam, recording: Recording) -> Prediction:
    """Predict a recording and compare the prediction with it."""
    path = predict(beam, recording)
    error = rms_distance(path - window(recording))
    rest = marker_motion(beam, rest_angles(beam), recording.place)
    return Prediction(path, ring(path, natural_hz(beam)), error, rest)


def rms_distance(error: Float[np.ndarray, "*any 2"]) -> float:
    """Return the RMS length of vectors."""
    return float(np.sqrt((error**2).sum(axis=-1).mean()))


def constant_loss(config: FinConfig, load_n: float) -> FinConfig:
    """Return a configuration with which the beam has the same loss factor with a weight as the
    configuration gives it without one.

    The loss factor is the circular frequency times the damping time.
    """
    unloaded, loaded = (natural_hz(make_beam(config, load, is_stocky=True)) for load in (0, load_n))
    return config.model_copy(update={"damping_s": config.damping_s * unloaded / loaded})


def variants(recordings: Sequence[Recording]) -> dict[str, Callable[[float], Beam]]:
    """Fit the models to recordings without a weight; return functions that add a weight [N]."""
    thin, stocky = (fit(recordings, is_stocky) for is_stocky in (False, True))
    for name, config in (("chain", thin), ("with shear", stocky)):
        modulus = config.youngs_modulus_pa
        print(f"{name}: {modulus:.0f} Pa, {1e3 * config.damping_s:.2f} ms")
    return {
        "chain": lambda load_n: make_beam(thin, load_n, is_stocky=False),
        "with shear": lambda load_n: make_beam(stocky, load_n, is_stocky=True),
        "with shear, constant loss factor": lambda load_n: make_beam(
            constant_loss(stocky, load_n), load_n, is_stocky=True
        ),
    }


def table(
    recordings: Mapping[str, Sequence[Recording]],
    predictions: Mapping[str, Mapping[str, Sequence[Prediction]]],
) -> str:
    """Return the table of the docs; both repetitions are in one cell."""
    names = list(predictions)
    lines = [
        f"| weight | | measured | FEM | {' | '.join(names)} |",
        "| --- | --- | --- | --- |" + " --- |" * len(names),
    ]

    def add(case: Case, title: str, *cells: Iterable[float], digits: int) -> None:
        texts = [", ".join(f"{value:.{digits}f}" for value in cell) for cell in cells]
        lines.append(f"| {case.load_n:.2f} N | {title} | {' | '.join(texts)} |")

    for case in CASES:
        recorded = recordings[case.name]
        predicted = [predictions[name][case.name] for name in names]
        guess = predicted[0][0].ring.frequency_hz
        measured = [ring(window(recording), guess) for recording in recorded]
        for field, (title, digits) in enumerate((("frequency [Hz]", 2), ("decay [1/s]", 2))):
            rings = ([each.ring[field] for each in column] for column in predicted)
            add(case, title, [each[field] for each in measured], (), *rings, digits=digits)
        errors = ([1e3 * each.error_m for each in column] for column in predicted)
        add(case, "marker error [mm]", (), (), *errors, digits=1)
        sags = ([-1e3 * each.rest[:, 1].mean() for each in column] for column in predicted)
        sag = [-1e3 * recording.rest[:, 1].mean() for recording in recorded]
        fem = [-1e3 * case.fem_m[:, 1].mean()]
        add(case, "sag at rest [mm]", sag, fem, *sags, digits=1)
        misses = (
            [
                1e3 * rms_distance(each.rest - recording.rest)
                for each, recording in zip(column, recorded, strict=True)
            ]
            for column in predicted
        )
        fem = [1e3 * rms_distance(case.fem_m - recording.rest) for recording in recorded]
        add(case, "marker error at rest [mm]", (), fem, *misses, digits=1)
    return "\n".join(lines)


def draw(
    recordings: Mapping[str, Sequence[Recording]],
    predictions: Mapping[str, Mapping[str, Sequence[Prediction]]],
) -> Figure:
    """Draw the mean height of the tip markers in the first repetition of each experiment."""
    titles = ("no weight (fitted)", "52 g (predicted)", "101 g (predicted)")
    times = np.arange(WINDOW_FRAMES) / RATE_HZ
    with styled():
        figure = new_figure(8, 2.9)
        for axes, case, title in zip(figure.subplots(1, 3), CASES, titles, strict=True):
            measured = 1e3 * window(recordings[case.name][0])[..., 1].mean(axis=1)
            axes.plot(times, measured, ".", color=BLACK, markersize=3, label="measured")
            for name, colour, line in (
                ("chain", BLUE, "-"),
                ("with shear, constant loss factor", ORANGE, "--"),
            ):
                path = predictions[name][case.name][0].path
                height = 1e3 * path[..., 1].mean(axis=1)
                axes.plot(times, height, line, color=colour, label=name)
            axes.set(title=title, xlabel="time after the first trough [s]")
        figure.axes[0].set_ylabel("height above straight [mm]")
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    return figure


def load_all(folder: Path) -> dict[str, list[Recording]]:
    """Load both repetitions of each experiment."""
    return {
        case.name: [load_recording(folder / f"beam_{case.name}_V2_{letter}.c3d") for letter in "ab"]
        for case in CASES
    }


def main(folder: Path, figure: Path) -> None:
    """Print the table and draw the figure."""
    recordings = load_all(folder)
    predictions = {
        name: {
            case.name: [evaluate(beam(case.load_n), each) for each in recordings[case.name]]
            for case in CASES
        }
        for name, beam in variants(recordings["gravity"]).items()
    }
    print(table(recordings, predictions))
    for case in CASES:
        sideways = ", ".join(f"{1e3 * each.sideways_m:.1f}" for each in recordings[case.name])
        print(f"{case.name}: {sideways} mm sideways at rest")
    save_figure(draw(recordings, predictions), figure)


if __name__ == "__main__":
    with jax.enable_x64(True):
        main(Path(sys.argv[1]), Path(sys.argv[2]))
