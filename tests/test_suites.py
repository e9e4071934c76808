"""The suites' measurements: the requested ones, each independent of the others."""

from experiments.benchmarks import suites
from experiments.benchmarks.measurements import Measurement


def request(**given):
    fields = dict.fromkeys(suites.Request._fields, ()) | {"profile": False, "peer_python": "python"} | given
    return suites.Request(**fields)


def test_a_measurement_that_raises_is_a_failure_and_the_next_is_made(monkeypatch):
    def raises(*case, **timing):
        yield Measurement("checkpoint", "a", 5, "checkpoints", 1.0)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(suites, "bench_checkpoint", raises)
    asked = request(suites=["checkpoint"], members=[5], algos=["td3", "sac"], tasks=["ant"])
    found = list(suites.measure_all(asked, {}, seconds=0.0, repeats=1))
    assert [getattr(row, "why", "") for row in found] == ["", "OSError: [Errno 28] No space left on device"] * 2
    assert found[3].what == "checkpoint: sac, ant"


def test_every_suite_makes_its_measurements(monkeypatch):
    made = []
    names = ("env", "physics", "updates", "replay", "memory", "batches", "kernels", "starts", "checkpoint", "loops")
    for name in names:
        monkeypatch.setattr(
            suites, f"bench_{name}", lambda *case, name=name, **timing: made.append((name, *case)) or []
        )
    monkeypatch.setattr(suites.growth, "measure_growth", lambda *case, **timing: made.append(("growth", *case)) or [])
    monkeypatch.setattr(suites.compare, "compare", lambda *case, **timing: made.append(("compare", *case)) or [])
    monkeypatch.setattr(suites.measure_gpu, "parts_of", lambda *case, **timing: (*case, *timing.values()))
    monkeypatch.setattr(
        suites.measure_gpu, "bench_gpu", lambda parts, *times: made.append(("gpu", *parts, *times)) or []
    )
    asked = request(
        suites=[*suites.SUITES, *suites.MORE_SUITES],
        parts=["loops"],
        patience=2.0,
        minutes=9.0,
        tasks=["ant"],
        algos=["td3", "td7"],
        physics=["mjx"],
        compiled_physics=["warp"],
        members=[5],
        devices=[None],
        capacities=[10],
        compare=["sbx"],
    )
    assert list(suites.measure_all(asked, {}, seconds=0.0, repeats=3)) == []
    assert made == [
        ("env", "ant", 5, "mjx"),
        ("physics", "ant", 5, ()),
        ("updates", "td3", "ant", 5, [None]),
        ("updates", "td7", "ant", 5, [None]),
        *(("replay", kind, what, "ant", 10, 5) for kind in ("uniform", "lap") for what in ("insert", "sample")),
        ("loops", "td3", "ant", 5, ["mjx"], [None], False),
        ("loops", "td7", "ant", 5, ["mjx"], [None], False),
        ("checkpoint", "td3", "ant", 5, 3),
        ("checkpoint", "td7", "ant", 5, 3),
        ("memory", "td3", "ant", 5, 10, "mjx"),
        ("memory", "td7", "ant", 5, 10, "mjx"),
        ("batches", "td3", "ant", 5, "mjx"),
        ("batches", "td7", "ant", 5, "mjx"),
        ("kernels", "td3", "ant", 5, "warp"),
        ("kernels", "td7", "ant", 5, "warp"),
        ("starts", "td3", "ant", 5, "mjx"),
        ("starts", "td7", "ant", 5, "mjx"),
        ("gpu", ["loops"], "ant", [5], ["mjx"], 0.0, 3, 2.0, 9.0),
        ("growth", ["td3", "td7"], "ant", 5),
        ("compare", "sbx", "td3", "ant", 5, ["mjx"], "python", {}),
    ]
