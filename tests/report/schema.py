"""result.json as strict pydantic models: no key but those named, every number finite or null."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class Entry(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)


class Known(Entry):
    value: float
    std: float | None
    std_discretisation: float | None
    ci95: list[float | None] | None = Field(min_length=2, max_length=2)  # None: no end


class VirtualLink(Entry):
    length: float
    mass_center: float
    mass: float
    inertia: float


class VirtualJoint(Entry):
    stiffness: Known
    damping: Known


class LinkResult(Entry):
    name: str
    bending_stiffness: Known
    hub_inertia: float
    virtual_links: list[VirtualLink]
    virtual_joints: list[VirtualJoint]


class ModelResult(Entry):
    links: list[LinkResult]


class Frequency(Entry):
    model: float
    measured: float | None
    measured_std: float | None = None


class Damping(Entry):
    model: float
    measured: float | None


class Objective(Entry):
    torque: float | None
    trajectory_chi2_per_sample: float | None


class Whiteness(Entry):
    chi2_per_sample: float | None
    largest_correlation: float | None
    coloured: bool


class RecordingResult(Entry):
    file: str
    role: Literal["train", "holdout"]
    marker_rms_m: float | None
    theta_rms_rad: float | None
    noise_m: float
    nominal_marker_rms_m: float | None
    torque_marker_rms_m: float | None
    left_out: int = Field(ge=0)
    problem: str


class FittedRecording(RecordingResult):
    whiteness: Whiteness | None


class Identifiable(Entry):
    parameter: str
    identifiable: bool
    reason: str
    remedy: str


class EstimateResult(Entry):
    parameter: str
    value: float | None
    std: float | None
    std_discretisation: float | None
    ci95: list[float | None] | None = Field(min_length=2, max_length=2)  # None: no end
    unit: str


class Common(Entry):
    schema_version: Literal[1] = Field(alias="schema")
    command: str
    vjm: str
    experiment: str
    warnings: list[str]


class IdentifyResult(Common):
    command: Literal["identify"]
    notes: list[str]
    method: Literal["torque", "torque+frequency", "trajectory"]
    parameters: Literal["uniform", "joints", "lengths", "full"]
    model: ModelResult
    frequencies_hz: list[Frequency]
    damping_ratios: list[Damping]
    mode_shape_mac: list[float | None]
    objective: Objective
    recordings: list[FittedRecording]
    status: Literal["converged", "not converged", "failed"]
    remedy: str
    identifiable: list[Identifiable]
    estimates: list[EstimateResult]


class EffectResult(Entry):
    effect: str
    link: str | None
    parameters: dict[str, float | None]


class SimulateResult(Common):
    command: Literal["simulate"]
    model: ModelResult
    frequencies_hz: list[Frequency]
    effects: list[EffectResult]
    recordings: list[RecordingResult]


class Size(Entry):
    value: float | None
    std: float | None
    std_discretisation: float | None
    ci95: list[float | None] | None = Field(min_length=2, max_length=2)  # None: no end
    unit: str


class Alternative(EffectResult):
    chi2_increase: float | None


class CauseResult(Entry):
    effect: str
    link: str | None
    parameters: dict[str, Size]
    p_value: float | None
    chi2_gain: float | None
    indistinguishable_from: list[str]
    alternatives: list[Alternative]
    evidence: str
    role: Literal["main", "minor"]
    holdout_gain_m: float | None


class FollowedRecording(Entry):
    file: str
    role: Literal["train", "holdout"]
    marker_rms_before_m: float | None
    marker_rms_after_m: float | None
    marker_rms_next_best_m: float | None
    noise_m: float | None


class GainResult(Entry):
    holdout_rms_before_m: float
    holdout_rms_after_m: float
    holdout_rms_next_best_m: float | None
    noise_m: float
    reduction: float | None
    ci95: list[float | None] = Field(min_length=2, max_length=2)


class CandidateResult(Entry):
    effect: str
    link: str | None
    z: float | None
    p_value: float | None
    size: dict[str, float | None]
    smallest_detectable: dict[str, float | None]
    residual: float | None
    residual_bound: Literal["lower", "upper"] | None
    holdout_rms_m: float | None
    testable: bool
    reason: str


class Remaining(Entry):
    p_value: float | None
    description: str


class BudgetResult(Entry):
    seconds: float | None
    spent: float
    exhausted: bool
    not_tried: list[str]


class DiagnoseResult(Common):
    command: Literal["diagnose"]
    notes: list[str]
    verdict: Literal["none", "named", "set", "unknown", "insufficient"]
    causes: list[CauseResult]
    recordings: list[FollowedRecording]
    gain: GainResult | None
    candidates: list[CandidateResult]
    remaining: Remaining
    next_experiment: str | None
    symptoms: list[str]
    noise: str
    budget: BudgetResult
    recommended: Literal["with causes", "without causes"]
    model: ModelResult
    estimates: list[EstimateResult]


class CheckedLink(Entry):
    name: str
    virtual_joints: int | None


class CheckedRecording(Entry):
    file: str
    kind: Literal["driven", "decay", "static", "quiet"]
    role: Literal["train", "holdout"]
    duration_s: float
    frames: int
    missing_cells: int
    frames_per_s: float
    encoder_samples_per_s: float | None
    noise_m: float
    motion_over_noise: float
    modes_hz: list[float]


class CheckResult(Common):
    command: Literal["check"]
    problem: str
    links: list[CheckedLink]
    frequencies_hz: list[Frequency]
    recordings: list[CheckedRecording]
    identifiable: dict[Literal["uniform", "joints", "lengths", "full"], list[Identifiable]]


class UrdfResult(Common):
    command: Literal["urdf"]
    file: str | None
    joints: list[str]
    urdf: str | None


class UrdfForResult(UrdfResult):
    simulator_file: str
    left_out: list[str]


class DemoResult(IdentifyResult):
    diagnosis: DiagnoseResult
