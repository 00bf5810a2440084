"""The measured silicone beam's decays: what any linear law of loss leaves of them, and how far two recordings differ.

Of one recording, or two of the same condition, the deflection of the tip in its single visible mode is fitted by a
damped oscillator with Maxwell elements beside its spring, whose time constants, sizes and initial forces are all free.
A linear viscoelastic law, be it fractional or of many elements, leaves no less than enough of these do. Beside it the
damping ratio, period by period, against the amplitude: a law of the motion at hand gives two recordings the same
damping at the same amplitude. Needs the recordings beside the repository; no model of vjm's is used.
"""

import numpy as np
from clock import ROOT, header
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.optimize import least_squares

import vjm

Array = NDArray[np.float64]
FILE = ROOT.parent / "shared" / "data" / "silicone_beam" / "experiment.toml"
INTERVAL = 0.01  # s
ELEMENTS = (1, 2, 3)


def deflections(file: str) -> Array:
    """Deflection of the tip [mm]."""
    (recording,) = (each for each in vjm.load_experiment(FILE).recordings if each.file == file)
    return np.asarray(1e3 * recording.markers[:, 0, 1])


def response(rates: Array, start: Array, count: int) -> Array:
    """First state of a linear system with constant rates (n, n), at equal intervals."""
    values, vectors = np.linalg.eig(expm(rates * INTERVAL))
    shares = vectors[0] * np.linalg.solve(vectors, start.astype(complex))
    return np.asarray((values[:, None] ** np.arange(count)).T @ shares).real


def oscillator(stiffness: float, damping: float, springs: Array, times: Array) -> Array:
    """Rates of deflection, its rate, and the deflections of Maxwell elements, per unit mass."""
    rates = np.zeros((2 + springs.size, 2 + springs.size))
    rates[0, 1], rates[2:, 1] = 1.0, 1.0
    rates[1] = np.r_[-stiffness, -damping, -springs]
    rates[2:, 2:] = -np.diag(1 / times)
    return rates


def least_left(decays: list[Array], pulsation: float, elements: int) -> Array:
    """Residuals [mm] of the best linear law with so many Maxwell elements, all decays' initial states free."""
    stiffness = pulsation**2
    sizes = np.log(np.r_[stiffness, 0.05 * pulsation, np.full(elements, 0.08 * stiffness)])
    times = np.log(np.geomspace(1.0, 0.02, elements) if elements > 1 else [0.9])
    states = [np.r_[decay[0], np.zeros(1 + elements)] for decay in decays]
    start, law = np.concatenate([sizes, times, *states]), 2 + 2 * elements

    def residuals(x: Array) -> Array:
        sizes, times = np.split(np.exp(x[:law]), [2 + elements])
        rates = oscillator(sizes[0], sizes[1], sizes[2:], times)
        states = x[law:].reshape(len(decays), -1)
        pairs = zip(decays, states, strict=True)
        return np.concatenate([response(rates, state, decay.size) - decay for decay, state in pairs])

    lower, upper = np.full(start.size, -np.inf), np.full(start.size, np.inf)
    lower[:law], upper[:law] = -14.0, 14.0
    lower[2 + elements : law], upper[2 + elements : law] = np.log(0.004), np.log(50.0)  # s
    scale = np.maximum(np.abs(start), 0.3)
    return np.asarray(least_squares(residuals, start, x_scale=scale, bounds=(lower, upper), max_nfev=100).fun)


def damping_by_amplitude(decay: Array, pulsation: float) -> Array:
    """Amplitude [mm] and damping ratio (k, 2) of a damped sinusoid beside a constant, in 1.5 periods each."""
    count = round(1.5 * 2 * np.pi / pulsation / INTERVAL)
    time, found = INTERVAL * np.arange(count), []
    for first in range(0, decay.size - count, 2 * count // 3):
        part = decay[first : first + count]

        def residuals(x: Array, part: Array = part) -> Array:
            return np.asarray(
                np.exp(-x[0] * time) * (x[2] * np.cos(x[1] * time) + x[3] * np.sin(x[1] * time)) + x[4] - part
            )

        x = least_squares(residuals, [0.05 * pulsation, pulsation, part.max(), 0.0, 0.0], x_scale="jac").x
        found.append((np.hypot(x[2], x[3]) * np.exp(-x[0] * time[-1] / 2), x[0] / x[1]))
    return np.array(found)


def main() -> None:
    header("the silicone beam's decays, by linear laws of loss")
    for condition, pulsation in (("unloaded", 49.0), ("loaded", 27.6)):
        files = [f"{condition}_a.csv", f"{condition}_b.csv"]
        decays = [deflections(file) for file in files]
        for chosen in ([0], [1], [0, 1]):
            left = [least_left([decays[k] for k in chosen], pulsation, elements) for elements in ELEMENTS]
            title = f"{' and '.join(files[k] for k in chosen)}, RMS left by {', '.join(map(str, ELEMENTS))} elements"
            print(f"{title}: {', '.join(f'{1e3 * np.sqrt(np.mean(each**2)):.1f}' for each in left)} um")
        first, second = (damping_by_amplitude(decay, pulsation) for decay in decays)
        for amplitude in (2.0, 1.0, 0.5):  # mm
            ratios = [np.interp(-np.log(amplitude), -np.log(each[:, 0]), each[:, 1]) for each in (first, second)]
            print(f"{condition}, damping ratio at {amplitude} mm: {ratios[0]:.4f} and {ratios[1]:.4f}")


if __name__ == "__main__":
    main()
