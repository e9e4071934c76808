"""One measurement of the benchmark, and measuring several cases interleaved.

Cases to be compared are all prepared first, then timed interleaved (`measure_cases`). A case that fails yields a
`Failure` in place of its `Measurement`.
"""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from experiments.benchmarks import kernels
from experiments.benchmarks.timing import rates_or_errors
from sqt_jax.members import usable_devices
from sqt_jax.types import Array

MEGABYTES = "MB"
SECONDS = "s"
KERNELS = "kernels per step"
HOST_SYNCS = "host syncs per step"
GRAPHS = "CUDA graphs per step"
ERROR = "m/s or rad/s, median error"
EQUAL = "% of the arrays equal"
AMOUNTS = (MEGABYTES, SECONDS, KERNELS, HOST_SYNCS, GRAPHS, ERROR, EQUAL)  # units of a figure that is not a rate
PROFILED_STEPS = 4  # lockstep steps; the actor learns in half of them


@dataclasses.dataclass(frozen=True)
class Measurement:
    """One figure. `rate` counts the unit in all members together, per second."""

    suite: str
    what: str
    members: int
    unit: str
    rate: float = 0.0
    compile_seconds: float | None = None  # None: not measured
    operations: float = 0.0  # floating-point operations of one unit; 0: not counted
    devices: int = 1
    kinds: tuple[kernels.Kind, ...] | None = None  # device operations of a lockstep step; None: not profiled
    point: tuple[str, str, int] | None = None  # of a growth figure: varied quantity, line, value
    rates: tuple[float, ...] = ()  # of each repeat; `rate` is their median

    @property
    def figure(self) -> tuple[str, str]:
        """The rate and its unit as text."""
        rate = f"{self.rate:,.0f}" if self.rate >= 100 else f"{self.rate:.3g}"
        return rate, self.unit if self.unit in AMOUNTS else f"{self.unit}/s"


class Failure(NamedTuple):
    """A measurement that failed, and why, in one line."""

    what: str
    why: str


class Prepared(NamedTuple):
    """A loop that is ready to be timed."""

    run: Callable[[int], Any]  # number of iterations, each of all members -> arrays to wait for
    operations: float = 0.0  # as in `Measurement`
    compile_seconds: float | None = None  # None: the seconds of the first call


class Case(NamedTuple):
    """One loop to measure: its `Measurement` without figures, and the function that prepares it."""

    measurement: Measurement
    prepare: Callable[[], Prepared]


def measure_cases(cases: Sequence[Case], profiled: bool = False, **timing: Any) -> Iterator[Measurement | Failure]:
    """Prepares all cases and measures them interleaved. A case that fails yields a `Failure`; the others continue.

    Args:
      profiled: also profile each loop; if the profile fails, the measurement follows without one.
      timing: `seconds` and `repeats` of `timing.measure`.
    """
    ready = []
    for measurement, prepare in cases:
        try:
            ready.append((measurement, prepare()))
        except Exception as error:
            yield failure(measurement, error)
    runs = [prepared.run for _, prepared in ready]
    for (measurement, prepared), found in zip(ready, rates_or_errors(runs, **timing), strict=True):
        if isinstance(found, Exception):
            yield failure(measurement, found)
            continue
        measurement = dataclasses.replace(
            measurement,
            rate=found.rate * measurement.members,
            rates=tuple(rate * measurement.members for rate in found.rates),
            compile_seconds=found.compile_seconds if prepared.compile_seconds is None else prepared.compile_seconds,
            operations=prepared.operations,
        )
        if profiled:
            try:
                kinds = tuple(kernels.profile(prepared.run, PROFILED_STEPS))
                measurement = dataclasses.replace(measurement, kinds=kinds)
            except Exception as error:
                yield failure(measurement, error, "profile of ")
        yield measurement


def failure(measurement: Measurement, error: Exception, part: str = "") -> Failure:
    """The failure of a measurement, or of a `part` of it."""
    return Failure(f"{part}{measurement.suite}: {measurement.what}, {measurement.members} members", error_line(error))


def error_line(error: Exception) -> str:
    """An exception as one line: its class and the first line of its text."""
    line = next(filter(None, map(str.strip, str(error).splitlines())), "")
    return f"{type(error).__name__}: {line[:300]}"


def preparing(steps: Callable[..., Callable[[int], Any]], *arguments: Any, **options: Any) -> Callable[[], Prepared]:
    """A `Case.prepare` that calls `steps(*arguments, **options)` for the loop."""
    return lambda: Prepared(steps(*arguments, **options))


def member_keys(members: int) -> Array:
    """A random key for each member, [M]."""
    return jax.vmap(jax.random.key)(jnp.arange(members))


def with_devices(what: str, devices: int) -> str:
    """A measurement's `what`, extended by its number of devices if that is more than one."""
    return f"{what}, {devices} devices" if devices > 1 else what


def device_counts(devices: Sequence[int | None], members: int) -> list[int]:
    """The numbers of devices that have at least one member each; None is the number that a run would use.

    Prints a line if no number remains.
    """
    chosen = [usable_devices(members) if count is None else count for count in devices]
    found = [count for count in dict.fromkeys(chosen) if count <= members]
    if not found:
        numbers = " or ".join(map(str, chosen))
        print(
            f"no measurement of {members} members on {numbers} devices: each device needs at least one member",
            flush=True,
        )
    return found
