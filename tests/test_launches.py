# ruff: noqa: E501
"""What a GPU would launch, counted in a small program's text by hand."""

import pytest

from experiments.benchmarks.launches import count

TEXT = """HloModule jit_advance, is_scheduled=true

%fused_add (param.0: f32[2]) -> f32[2] {
  %param.0 = f32[2]{0} parameter(0)
  ROOT %add.1 = f32[2]{0} add(%param.0, %param.0)
}

%substeps (arg: (s32[], f32[2])) -> (s32[], f32[2]) {
  %arg = (s32[], f32[2]{0}) parameter(0)
  %call.1 = (f32[2]{0}, s8[4]{0}) custom-call(%arg), custom_call_target="step", metadata={op_name="while/physics/step"}
  ROOT %copy.1 = f32[2]{0} copy(%call.1)
}

%actor (arg: (pred[], f32[2])) -> (pred[], f32[2]) {
  %arg = (pred[], f32[2]{0}) parameter(0)
  ROOT %fusion.1 = f32[2]{0} fusion(%arg), kind=kLoop, calls=%fused_add, metadata={op_name="update/every_4_updates/while/body/add"}
}

%yes (arg: f32[2]) -> f32[2] {
  %arg = f32[2]{0} parameter(0)
  ROOT %fusion.2 = f32[2]{0} fusion(%arg), kind=kLoop, calls=%fused_add
}

%no (arg: f32[2]) -> f32[2] {
  ROOT %arg = f32[2]{0} parameter(0)
}

%begin (arg: (pred[], f32[2])) -> (pred[], f32[2]) {
  %arg = (pred[], f32[2]{0}) parameter(0)
  %sort.1 = f32[2]{0} sort(%arg)
  ROOT %while.9 = (pred[], f32[2]{0}) while(%arg), condition=%goes_on, body=%yes, metadata={op_name="vmap(restart)/while/body/while"}
}

%goes_on (arg: (pred[], f32[2])) -> pred[] {
  %arg = (pred[], f32[2]{0}) parameter(0)
  ROOT %get-tuple-element.5 = pred[] get-tuple-element(%arg), index=0
}

%less (arg: (s32[], f32[2])) -> pred[] {
  %arg = (s32[], f32[2]{0}) parameter(0)
  ROOT %fusion.8 = pred[] fusion(%arg), kind=kLoop, calls=%fused_add
}

%body (arg: (s32[], f32[2])) -> (s32[], f32[2]) {
  %arg = (s32[], f32[2]{0}) parameter(0)
  %get-tuple-element.1 = f32[2]{0} get-tuple-element(%arg), index=1
  %fusion.3 = f32[2]{0} fusion(%arg), kind=kLoop, calls=%fused_add, metadata={op_name="jit(advance)/while/body/act/add"}
  %custom-call.7 = f32[2]{0} custom-call(%arg), custom_call_target="Sharding"
  %while.1 = (s32[], f32[2]{0}) while(%arg), condition=%less, body=%substeps, metadata={op_name="while/physics/while"}, backend_config={"known_trip_count":{"n":"5"}}
  %while.2 = (pred[], f32[2]{0}) while(%arg), condition=%goes_on, body=%actor, metadata={op_name="update/every_4_updates/while"}
  %while.3 = (pred[], f32[2]{0}) while(%arg), condition=%goes_on, body=%begin, metadata={op_name="vmap(restart)/while"}
  ROOT %conditional.1 = f32[2]{0} conditional(%arg), true_computation=%yes, false_computation=%no, metadata={op_name="feedback/cond"}
}

ENTRY %main (arg: (s32[], f32[2])) -> (s32[], f32[2]) {
  %arg = (s32[], f32[2]{0}) parameter(0)
  %copy.9 = s32[] copy(%arg)
  ROOT %while.4 = (s32[], f32[2]{0}) while(%arg), condition=%less, body=%body, metadata={op_name="jit(advance)/while"}
}
"""
PARTS = ("act", "physics", "restart", "update", "feedback")


def test_a_steps_kernels_by_part():
    found = count(TEXT, PARTS, {"restart": 0.1}).kernels
    assert found == pytest.approx(
        {
            "act": 1,
            "physics": 5 * 2,  # a call and a copy in each of five iterations
            "update every 4": 1 / 4,
            "restart": 0.1 * 2,  # the sort, and one iteration of the loop inside
            "feedback": 1,  # of both branches, each as if it always ran
            "other": 1,  # the condition of the loop of steps
        }
    )
    assert count(TEXT, PARTS, {"restart": 0.1}).total == pytest.approx(13.45)


def test_the_host_reads_the_conditions_of_unknown_loops_and_of_conditionals():
    found = count(TEXT, PARTS, {"restart": 0.1}).host_syncs
    restart = 1 + 0.1 + 0.1 * (1 + 1)  # a restart, and the loop inside, which runs at each
    assert found == pytest.approx({"the loop of steps": 1, "update every 4": 1.25, "restart": restart, "feedback": 1})


def test_without_parts_everything_is_other():
    assert set(count(TEXT, (), {}).kernels) == {"other", "other every 4"}
    assert count(TEXT, (), {}).kernels["other"] == 1 + 1 + 10 + 2 + 1  # restarts count as if they ran at each step
