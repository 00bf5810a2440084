"""Numbers and sentences as an engineer says them."""

from __future__ import annotations

import math

_MICRO, _MILLI = 1e-5, 1e-3
_LEAST_DEGREES = 0.1
_TIMES = 2.0  # a ratio beyond this is no matter of per cent
_MOST_EXPONENT = 10.0
_SLIGHT = 0.05  # of a change: less is none


def plain(value: float, digits: int = 2) -> str:
    """A number's size with so many significant digits, without a power of ten: `0.40`, `1200`."""
    size = abs(value)
    if size == 0 or not math.isfinite(size):
        return "0"
    exponent = int(f"{size:.{digits - 1}e}".split("e")[1])
    return f"{round(size, digits - 1 - exponent):.{max(digits - 1 - exponent, 0)}f}"


def quantity(value: float, unit: str) -> str:
    """The size of a number in a unit that suits it: lengths in mm or µm, angles in deg or mrad, times in s or ms.

    Args:
        value: in the unit given.
        unit: `m`, `rad` or `s`, accelerations of these, or anything else, which is left alone.
    """
    scale, name = 1.0, unit
    if unit == "m":
        scale, name = (1e6, "µm") if abs(value) < _MICRO else (1e3, "mm")
    elif unit == "rad":
        degrees = math.degrees(abs(value))
        scale, name = (math.degrees(1.0), "deg") if degrees >= _LEAST_DEGREES else (1e3, "mrad")
    elif unit == "s":
        scale, name = (1e6, "µs") if abs(value) < _MICRO else (1e3, "ms") if abs(value) < 1 else (1.0, "s")
    elif unit == "m/s²" and abs(value) < 1:
        scale, name = 1e3, "mm/s²"
    return f"{plain(value * scale)} {name}"


def percent(value: float) -> str:
    """The size of a ratio: `0.40 %`."""
    return f"{plain(100 * value)} %"


def either(value: float, positive: str, negative: str) -> str:
    """One of two words, by the sign."""
    return positive if value > 0 else negative


def offset(sensor: str, value: float, unit: str) -> str:
    """A constant difference [m or rad]."""
    return f"{sensor} reads {quantity(value, unit)} {either(value, 'more', 'less')} than the model, all the time"


def gain(sensor: str, value: float) -> str:
    """A difference in size, relative."""
    return f"{sensor} moves {percent(value)} {either(value, 'more', 'less')} than in the model"


def delay(who: str, value: float) -> str:
    """A difference in time [s]."""
    return f"the motion {who} comes {quantity(value, 's')} {either(value, 'later', 'earlier')} than in the model"


def drift(sensor: str, value: float, unit: str) -> str:
    """A difference that grows evenly over the recording [m or rad]."""
    return (
        f"{sensor} drifts away from the model, by {either(value, '+', '−')}{quantity(value, unit)} over the recording"
    )


def amplitude(frequency: float, value: float) -> str:
    """A difference in amplitude from the beginning, as a logarithm."""
    change = math.expm1(value)
    return (
        f"at {plain(frequency)} Hz the arm swings {percent(change)} {either(change, 'wider', 'less wide')} than the "
        "model from the start"
    )


def phase(frequency: float, value: float) -> str:
    """A difference in phase from the beginning [rad]."""
    return (
        f"at {plain(frequency)} Hz the arm is {quantity(value, 'rad')} {either(value, 'ahead of', 'behind')} the model "
        "from the start"
    )


def frequency(band: float, relative: float, duration: float, drift: float, ahead: float) -> str:
    """A difference in frequency.

    Args:
        band: [Hz].
        relative: of the frequency.
        duration: of the motion [s].
        drift: gained in that time [rad].
        ahead: phase at its end [rad].
    """
    swings = (
        f"the arm swings {percent(relative)} {either(relative, 'faster', 'slower')} at {plain(band)} Hz than the model"
    )
    together = drift * ahead > 0  # else it begins ahead and falls behind, or the other way round
    turned = ahead if together else drift
    angle = quantity(turned, "rad") if abs(turned) < 2 * math.pi else f"{plain(turned / (2 * math.pi))} periods"
    if together:
        return f"{swings}: after {plain(duration)} s it {either(ahead, 'leads', 'lags')} by {angle}"
    return f"{swings}: in {plain(duration)} s it {either(drift, 'gains', 'loses')} {angle}"


def damping(band: float, decay: float, duration: float) -> str:
    """A difference in the rate of decay [1/s] over some time [s]."""
    faster = either(decay, "faster", "more slowly")
    ratio = math.exp(min(max(-decay * duration, -_MOST_EXPONENT), _MOST_EXPONENT))
    size = f"{plain(ratio)} times the model's"
    if 1 / _TIMES < ratio < _TIMES:
        size = f"{percent(ratio - 1)} {either(ratio - 1, 'larger', 'smaller')} than the model's"
    after = f"after {plain(duration)} s its amplitude is {size}"
    return f"the swing at {plain(band)} Hz dies out {faster} than in the model: {after}"


def shape(band: float, sensor: str, value: float) -> str:
    """A marker that moves otherwise than the others say, as a logarithm."""
    change = math.expm1(value)
    more = either(change, "more", "less")
    return f"at {plain(band)} Hz {sensor} moves {percent(change)} {more} than the model, set against the other markers"


def rest_gain(value: float) -> str:
    """A difference in size of what is no vibration, relative."""
    return f"its vibrations apart, the arm moves {percent(value)} {either(value, 'more', 'less')} than the model"


def rest_delay(value: float) -> str:
    """A difference in time of what is no vibration [s]."""
    return (
        f"its vibrations apart, the arm moves {quantity(value, 's')} {either(value, 'later', 'earlier')} than the model"
    )


def tone(sensor: str, size: float, unit: str, frequency: float, simulated: float) -> str:
    """A motion at one frequency.

    Args:
        sensor: that shows it.
        size: of the residual's sine.
        unit: of that.
        frequency: [Hz].
        simulated: size of the model's motion at that frequency.
    """
    if simulated < size:
        return f"{sensor} swings by {quantity(size, unit)} at {plain(frequency, 3)} Hz, which the model does not"
    swing = quantity(simulated, unit)
    return f"at {plain(frequency, 3)} Hz, where the model swings by {swing}, {sensor} is off by {quantity(size, unit)}"


def with_amplitude(
    of: str, band: float, measured: float, simulated: float, limits: tuple[float, float], unit: str
) -> str:
    """A change of frequency or damping with amplitude.

    Args:
        of: `frequency`, relative, or `damping`, as a ratio.
        band: [Hz].
        measured: change from the smaller to the larger amplitude.
        simulated: the same of the model.
        limits: the amplitudes.
        unit: theirs.
    """
    small, large = (quantity(each, unit) for each in limits)
    if of == "frequency":
        changes = [f"{percent(each)} {either(each, 'faster', 'slower')}" for each in (measured, simulated)]
        what = f"the swing at {plain(band)} Hz"
    else:
        changes = [f"{plain(each)} {either(each, 'higher', 'lower')}" for each in (measured, simulated)]
        what = f"the damping ratio of the swing at {plain(band)} Hz"
    model = "is the same" if abs(simulated) < _SLIGHT * abs(measured) else f"is {changes[1]}"
    return f"at {large} {what} is {changes[0]} than at {small}; the model's {model}"


def against(kind: str, sensor: str, of: str, value: float, unit: str, motion: str) -> str:
    """A residual that goes with a motion.

    Args:
        kind: `against_angle`, `against_velocity` or `against_sign`.
        sensor: whose residual.
        of: `torque`, `acceleration`, or the `residual` itself.
        value: its change.
        unit: of that.
        motion: what moves.
    """
    what = f"the residual of {sensor}" if of == "residual" else f"the {of} missing at {sensor}"
    size = quantity(value, unit)
    if kind == "against_sign":
        return f"{what} jumps {either(value, 'up', 'down')} by {size} when {motion} turns from backwards to forwards"
    ends = (
        f"from low to high {motion}" if kind == "against_angle" else f"from fast backwards to fast forwards of {motion}"
    )
    return f"{what} {either(value, 'rises', 'falls')} by {size} {ends}"


def camera_lag(value: float) -> str:
    """A difference in time [s]."""
    return (
        f"the camera shows the motion {quantity(value, 's')} {either(value, 'later', 'earlier')} than the encoders do"
    )


def camera_clock(value: float) -> str:
    """A difference in the speed of time, relative."""
    return f"the camera's clock counts {percent(value)} {either(value, 'more', 'less')} time than the encoders'"


def quiet_size(sensor: str, value: float) -> str:
    """Noise at rest against what was supposed, relative."""
    return f"at rest, the noise of the {sensor} is {percent(value)} {either(value, 'larger', 'smaller')} than supposed"


def quiet_colour(sensor: str, value: float) -> str:
    """Correlation from one value to the next."""
    like = either(value, "resembles", "opposes")
    size = f"{either(value, '', '−')}{plain(value)}"
    return f"at rest, each value of the {sensor} {like} the one before (correlation {size})"


def course(growth: float) -> str:
    """Growth of a residual, as a logarithm."""
    more = either(growth, "grows", "shrinks")
    return f"the residual {more} {plain(math.exp(abs(growth)))}-fold from the first to the last fifth of the recording"


def wander(sensor: str, size: float, unit: str, limit: float) -> str:
    """A slow difference: its root mean square, and the frequency below which it is slow [Hz]."""
    return f"{sensor} wanders slowly about the model, by {quantity(size, unit)} RMS below {plain(limit)} Hz"


def sentence(file: str | None, words: str) -> str:
    """Words with the recording in front, and a full stop."""
    return f"{file}: {words}." if file is not None else f"{words[:1].upper()}{words[1:]}."
