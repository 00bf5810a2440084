"""Identify an arm, print what was found, and plot how the model predicts a recording that the fit never saw.

python examples/identify_and_plot.py [experiment.toml]      (without it: the data that come with vjm)
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import vjm

DEMO = Path(vjm.__file__).parent / "demo" / "experiment.toml"


def main(file: Path | str = DEMO) -> None:
    experiment = vjm.load_experiment(file)
    fit = vjm.identify(experiment)

    print(f"{experiment.rig.name}: {fit.status}")
    for parameter in fit.parameters:
        error = "not determined" if parameter.std is None else f"± {parameter.std:.2g}"
        print(f"  {parameter.name:25} {parameter.value:12.5g} {error:>12} {parameter.unit}")
    for mode in fit.modes:
        measured = "no peak" if mode.frequency_measured is None else f"{mode.frequency_measured:.4f} Hz measured"
        print(f"  {mode.frequency_model:.4f} Hz in the model, {measured}")

    recording = [*experiment.with_role("holdout"), *experiment.recordings][0]
    simulation = fit.model.simulate(recording)  # open loop; only its initial state comes from the recording
    tip = recording.markers[:, -1, 1]
    miss = tip - simulation.markers[:, -1, 1]

    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(8, 4.5), height_ratios=(3, 1))
    above.plot(recording.time, 1e3 * tip, ".", color="0.6", label="measured")
    above.plot(simulation.time, 1e3 * simulation.markers[:, -1, 1], lw=1, label="simulated")
    above.set_ylabel("tip marker y [mm]")
    above.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False)
    below.plot(recording.time, 1e3 * miss, ".", ms=3)
    below.set(xlabel="time [s]", ylabel="difference [mm]")
    figure.savefig("tip.png", dpi=150, bbox_inches="tight")
    print(f"{recording.file}: tip.png")


if __name__ == "__main__":
    main(*sys.argv[1:])
