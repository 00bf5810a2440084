"""The measured silicone beam, whose markers are told from its position of rest: what that leaves of its residuals.

The file says no gravity. A second diagnosis has it, across the beam in the plane of its swing (an assumption: what is
known of the recordings does not say so), and the sag added to the markers as the first one's model has it. Needs the
recordings beside the repository.
"""

from dataclasses import replace

import numpy as np
from clock import ROOT, header, line

import vjm
from vjm.chain.curve import marker_poses
from vjm.diagnosis.records import Diagnosis
from vjm.model.modes import linearise

FILE = ROOT.parent / "shared" / "data" / "silicone_beam" / "experiment.toml"
EFFECTS = ["tip_payload", "viscoelastic_creep", "structural_damping", "cubic_stiffness"]
GRAVITY = (0.0, -9.81)  # m/s^2


def with_sag(experiment: vjm.Experiment, model: vjm.Model) -> vjm.Experiment:
    """The experiment in the base frame: where the markers are, instead of how far from rest they are."""
    recordings = []
    for recording in experiment.recordings:
        arm = model.arm_in(recording)
        payload, sites = arm.inputs(recording).payload, [link.markers for link in experiment.rig.links]
        rest = linearise(arm.chain, payload, GRAVITY)[3]
        at_rest, straight = (marker_poses(arm.chain, q, sites, [False] * len(sites))[0] for q in (rest, 0 * rest))
        print(f"  {recording.file}: sag of the tip {1e3 * (at_rest - straight)[-1].round(5)} mm")
        recordings.append(replace(recording, markers=recording.markers + at_rest - straight, gravity=GRAVITY))
    return replace(experiment, rig=replace(experiment.rig, gravity=GRAVITY), recordings=tuple(recordings))


def report(title: str, diagnosis: Diagnosis) -> None:
    print(f"{title}: {diagnosis.verdict}, {', '.join(str(cause.effect) for cause in diagnosis.causes)}")
    for comparison in diagnosis.recordings:
        assert comparison.simulated is not None
        along, across = 1e3 * np.sqrt(np.nanmean(comparison.simulated.marker_residual**2, axis=(0, 1)))
        line(f"{comparison.recording.file}, RMS residual along the link", along, "mm")
        line(f"{comparison.recording.file}, across it", across, "mm")


def main() -> None:
    experiment = vjm.load_experiment(FILE)
    header("the silicone beam, told from its position of rest")
    before = vjm.diagnose(experiment, effects=EFFECTS, budget=float("inf"))
    report("as recorded", before)
    sagging = with_sag(experiment, before.model)
    report("with the sag and gravity", vjm.diagnose(sagging, effects=EFFECTS, budget=float("inf")))


if __name__ == "__main__":
    main()
