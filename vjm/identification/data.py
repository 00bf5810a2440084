"""Everything before the first fit: which recordings, which shape functions, which modes they show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from vjm.angles.estimate import AngleMethod
from vjm.chain.layout import DEFAULT_LAYOUT
from vjm.errors import InsufficientDataError
from vjm.experiment.cleaning import cleaned
from vjm.experiment.records import Experiment, Recording
from vjm.identification.plan import Plan, make_plan
from vjm.identification.prepare import Prepared, Settings, fitted_recordings, modes_in, motion_of, prepare
from vjm.noise import sensor_noise
from vjm.spectrum import MeasuredModes

_LEAST_MOTION = 2.0  # times the noise
_EXTRA_MODES = 2  # peaks looked for beyond the modes that the shapes show


@dataclass(frozen=True)
class Options:
    """How an experiment is read for identification.

    Attributes:
        parameters: the parametrisation.
        virtual_joints: n of every link; None: the experiment file's, or chosen.
        layout: where the links are cut.
        family: of the shape functions.
        angles: how angles are read off them; None: chosen.
        derivatives: `smoothing` or `interpolating`.
    """

    parameters: str = "uniform"
    virtual_joints: int | None = None
    layout: str = DEFAULT_LAYOUT
    family: str = "cantilever"
    angles: AngleMethod | None = None
    derivatives: str = "smoothing"


@dataclass(frozen=True)
class Data:
    """The fitted recordings as the methods see them.

    Attributes:
        options: how they were read.
        plan: shape functions, numbers of joints, cuts.
        settings: how the recordings were prepared.
        recordings: those a model is fitted to, without coordinates that cannot be right.
        prepared: those that the torque method can use, prepared.
        problems: why it cannot use the others, a sentence each.
        seen: modes of those with the commonest payload.
        payload: that payload [kg].
    """

    options: Options
    plan: Plan
    settings: Settings
    recordings: tuple[Recording, ...]
    prepared: tuple[Prepared, ...]
    problems: tuple[str, ...]
    seen: tuple[MeasuredModes, ...]
    payload: float


def read_data(experiment: Experiment, options: Options) -> Data:
    """Choose the recordings, clean and prepare them.

    Raises:
        InsufficientDataError: nothing to fit, or a link without markers.
    """
    rig = experiment.rig
    recordings = tuple(cleaned(rig, recording) for recording in fitted_recordings(experiment.recordings))
    noise = sensor_noise(rig, [cleaned(rig, recording) for recording in experiment.recordings])
    if max(motion_of(recording, noise) for recording in recordings) < _LEAST_MOTION:
        raise InsufficientDataError(
            "identification",
            "in no training recording does the arm move by more than its sensors' noise",
            "record it swinging or driven",
        )
    plan = make_plan(
        experiment,
        recordings,
        options.parameters,
        options.virtual_joints,
        options.layout,
        options.family,
        options.angles,
    )
    settings = Settings(plan.shape, options.derivatives, *noise)
    prepared, problems = [], []
    for recording in recordings:
        try:
            prepared.append(prepare(rig, plan.cuts, recording, settings))
        except InsufficientDataError as error:
            problems.append(str(error))
    chosen, payload = _commonest_payload([one.recording for one in prepared] or recordings)
    most = max(plan.shape.orders) + _EXTRA_MODES
    seen = tuple(modes_in(prepared[k], noise[0], most) for k in chosen if prepared)
    return Data(options, plan, settings, recordings, tuple(prepared), tuple(problems), seen, payload)


def _commonest_payload(recordings: Sequence[Recording]) -> tuple[list[int], float]:
    """Recordings with the payload that most of them have: frequencies are compared among equals only."""
    payloads = [recording.payload for recording in recordings]
    best = max(sorted(set(payloads)), key=payloads.count)
    return [k for k, payload in enumerate(payloads) if payload == best], best
