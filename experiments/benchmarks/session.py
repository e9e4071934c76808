"""One run of the benchmark: measures, prints and saves."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from experiments.benchmarks import operations, output, suites
from experiments.benchmarks.measurements import Failure, Measurement, error_line


def measure_and_save(
    request: suites.Request,
    environment: Mapping[str, str],
    *,
    json_path: Path | None,
    figures: Path,
    with_peak: bool,
    **timing: Any,
) -> list[Failure]:
    """Makes all measurements; prints and saves each when it is made, and prints tables at the end, also if interrupted.

    Args:
      environment: environment variables of the peers' processes.
      json_path: a file to write after each measurement.
      figures: folder of the suite growth's figures.
      with_peak: also measure the peak of matrix products, if updates were measured.
      timing: `seconds` and `repeats` of `timing.measure`.

    Returns:
      The measurements that failed.

    Raises:
      UsageError: the file or the figures cannot be written.
    """
    measurements: list[Measurement] = []
    failures: list[Failure] = []
    peak = 0.0

    def add(found: Measurement | Failure) -> None:
        output.print_result(found)
        if isinstance(found, Failure):
            failures.append(found)
        else:
            measurements.append(found)

    def save() -> None:
        if json_path:
            output.save_json(json_path, measurements, failures, peak)

    try:
        for found in suites.measure_all(request, environment, **timing):
            add(found)
            save()
        if with_peak and any(found.operations for found in measurements):
            try:
                peak = operations.peak(**timing)
                print(f"peak of matrix products: {peak / 1e9:,.0f} GFLOP/s", flush=True)
            except Exception as error:
                add(Failure("peak of matrix products", error_line(error)))
            save()
    finally:
        output.print_all(measurements, peak, figures)
    return failures
