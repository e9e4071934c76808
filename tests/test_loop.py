"""The host loop, with a sweep that only counts: evaluations, chunks, checkpoints, signals, divergence."""

import jax.numpy as jnp
import numpy as np
import pytest

from experiments.running.loop import Position, checkpoint_steps, train_loop
from sqt_jax.config import TrainConfig
from sqt_jax.evaluate import Evaluation
from sqt_jax.rollout import Episodes
from sqt_jax.train import Sweep, TrainState


class Recorder:
    """Two members, a sweep that counts instead of training (a second per 100 steps), and a silent display."""

    def __init__(self, train, breaks_at=None):
        self.train, self.breaks_at = train, breaks_at
        self.now, self.done = 0.0, 0
        self.calls, self.reports, self.statuses, self.messages = [], [], [], []
        self.sweep = Sweep(init=None, advance=self.advance, evaluate=self.evaluate, measure=self.measure, restart=None)
        self.evaluated = lambda steps, returns, lengths, speeds: None
        self.update, self.message = self.statuses.append, self.messages.append

    def advance(self, state, steps, learn):
        self.calls.append((steps, learn))
        self.done += steps * self.train.num_envs
        self.now += steps / 100
        broken = self.breaks_at is not None and self.done >= self.breaks_at
        return state._replace(
            env_steps=jnp.int32(self.done),
            gradient_steps=state.gradient_steps + steps * learn,
            diverged_at=np.array([-1, self.breaks_at if broken else -1]),
            means=state.means + steps * learn,
        )

    def measure(self, state):
        return {"updates": np.asarray(state.means)}

    def evaluate(self, state):
        self.now += 0.5
        returns = np.array([[self.done, self.done + 2], [0.0, 0.0]])
        evaluation = Evaluation(returns, lengths=np.full((2, 2), 10), speeds=np.full((2, 2), np.nan))
        return evaluation, {"value_bias": np.array([1.5, -2.5])}

    def run(self, stop=lambda: False, **options):
        self.saved, self.kept = [], []
        at = options.get("start", Position()).env_steps
        self.done = at
        state = TrainState(
            agent=None,
            timestep=None,
            episodes=Episodes.start(1),
            replay=None,
            key=None,
            env_steps=jnp.int32(at),
            gradient_steps=jnp.zeros((), jnp.int32),
            diverged_at=np.full(2, -1),
            means=jnp.zeros(2),
        )
        return train_loop(
            self.sweep,
            state,
            self.train,
            2,
            report=self.reports.append,
            display=self,
            stop=stop,
            clock=lambda: self.now,
            save=lambda state, position: self.saved.append(position),
            evaluated_at=lambda state, env_steps, returns: self.kept.append((int(state.env_steps), env_steps, returns)),
            **options,
        )


TRAIN = TrainConfig(steps=2_000, warmup_steps=750, eval_every=500)


def test_evaluations_are_at_zero_every_interval_and_the_end():
    recorder = Recorder(TRAIN)
    outcome = recorder.run()
    assert [report.env_steps for report in recorder.reports] == [0, 500, 1_000, 1_500, 2_000]
    assert recorder.reports[0].metrics == {}
    assert recorder.reports[2].returns.tolist() == [[1_000, 1_002], [0, 0]]
    assert all(report.bias["value_bias"].tolist() == [1.5, -2.5] for report in recorder.reports)
    assert (outcome.env_steps, outcome.interrupted, outcome.diverged) == (2_000, False, {})


def test_the_policies_of_each_evaluation_may_be_kept():
    recorder = Recorder(TRAIN, breaks_at=800)
    recorder.run()
    assert [(at, steps) for at, steps, _ in recorder.kept] == [(at, at) for at in (0, 500, 1_000, 1_500, 2_000)]
    for (_, _, returns), report in zip(recorder.kept, recorder.reports, strict=True):
        np.testing.assert_array_equal(returns, report.returns)  # NaN of a member that has diverged


def test_the_full_protocol_has_201_evaluations():
    recorder = Recorder(TrainConfig())
    recorder.run()
    assert len(recorder.reports) == 201


def test_chunks_end_at_the_warm_up_and_follow_the_speed():
    recorder = Recorder(TRAIN)
    recorder.run()
    assert recorder.calls[0] == (1, False)  # compiles
    assert sum(steps for steps, learn in recorder.calls if not learn) == 750
    assert sum(steps for steps, learn in recorder.calls if learn) == 1_250
    assert recorder.calls[1:3] == [(10, False), (200, False)]  # 100 steps a second, two seconds a chunk
    assert next(steps for steps, learn in recorder.calls if learn) == 1  # compiles too
    assert max(steps for steps, _ in recorder.calls) == 200
    assert int(recorder.reports[-1].gradient_steps) == 1_250


def test_environments_in_lockstep_share_the_steps():
    recorder = Recorder(TrainConfig(steps=400, warmup_steps=100, eval_every=200, num_envs=4))
    recorder.run()
    assert sum(steps for steps, _ in recorder.calls) == 100
    assert [report.env_steps for report in recorder.reports] == [0, 200, 400]


def test_metrics_are_over_the_steps_since_the_last_evaluation():
    recorder = Recorder(TRAIN)
    recorder.run()
    updates = [report.metrics["updates"].tolist() for report in recorder.reports[1:]]
    assert updates == [[0, 0], [250, 250], [500, 500], [500, 500]]


def test_phases_and_time_left_are_shown():
    recorder = Recorder(TRAIN)
    recorder.run()
    phases = [status.phase for status in recorder.statuses]
    assert phases[:3] == ["compiling the evaluation", "compiling the warm-up", "warm-up"]
    assert {"compiling the training", "training", "evaluating"} <= set(phases)
    last = recorder.statuses[-1]
    assert last.phase == "evaluating" and last.env_steps == 2_000
    assert last.left == (pytest.approx(0.5), False)  # the last evaluation itself
    assert last.steps_per_second == pytest.approx(200)  # of both members


def test_time_left_is_a_lower_bound_until_an_evaluation_was_timed():
    recorder = Recorder(TrainConfig(steps=2_000, warmup_steps=100, eval_every=1_000))
    recorder.run()
    training = [status for status in recorder.statuses if status.phase == "training"]
    for status in training[1:]:  # nothing was timed before the first
        assert status.left.at_least == (status.env_steps < 1_000)  # the first evaluation's time is compilation


def test_a_stopped_run_reports_its_last_interval():
    recorder = Recorder(TRAIN)
    outcome = recorder.run(stop=lambda: recorder.done >= 1_100)
    assert outcome.interrupted and 1_100 <= outcome.env_steps < 1_500
    last = recorder.reports[-1]
    assert last.returns is None and last.env_steps == outcome.env_steps
    assert last.metrics["updates"].tolist() == [outcome.env_steps - 1_000] * 2
    assert len(recorder.reports) == 4  # 0, 500, 1000 and the rest


def test_a_run_stopped_before_its_last_evaluation_is_interrupted():
    recorder = Recorder(TRAIN)
    outcome = recorder.run(stop=lambda: recorder.done >= 2_000)
    assert outcome.interrupted and outcome.env_steps == 2_000


def test_an_environment_that_fails_in_training_ends_the_run_at_the_step_before():
    recorder = Recorder(TRAIN)
    advance = recorder.advance

    def fail_at_900(state, steps, learn):
        if recorder.done + steps <= 900:
            return advance(state, steps, learn)
        return advance(state, 900 - recorder.done, learn)

    recorder.sweep = recorder.sweep._replace(advance=fail_at_900)
    outcome = recorder.run(failed=lambda: recorder.done == 900, checkpoint_every=500)
    assert outcome.interrupted and outcome.env_steps == 900
    assert [position.env_steps for position in recorder.saved] == [500, 900]
    assert [(report.env_steps, report.returns is None) for report in recorder.reports[1:]] == [
        (500, False),
        (900, True),
    ]


def test_an_environment_that_fails_in_an_evaluation_ends_the_run_without_its_returns():
    recorder = Recorder(TRAIN)
    evaluations = []
    evaluate = recorder.evaluate
    recorder.sweep = recorder.sweep._replace(evaluate=lambda state: (evaluations.append(state), evaluate(state))[1])
    outcome = recorder.run(failed=lambda: len(evaluations) == 3, checkpoint_every=2_000)
    assert outcome.interrupted and outcome.env_steps == 1_000
    assert [(position.env_steps, position.evaluated) for position in recorder.saved] == [(1_000, 500)]
    assert [report.returns is None for report in recorder.reports] == [False, False, True]


def test_a_member_that_diverges_is_named_once_and_its_later_returns_do_not_count():
    recorder = Recorder(TRAIN, breaks_at=800)
    outcome = recorder.run()
    assert outcome.diverged == {1: 800}
    assert recorder.messages == [
        "member 1 diverged at step 800: it is frozen at its last valid state; the others continue"
    ]
    assert not outcome.interrupted and outcome.env_steps == 2_000
    for report in recorder.reports:
        left_out = report.env_steps >= 1_000
        assert np.isnan(report.returns[1]).all() == np.isnan(report.bias["value_bias"][1]) == left_out
        assert np.isfinite(report.returns[0]).all()


def test_checkpoints_are_at_their_interval_and_at_the_end():
    assert checkpoint_steps(300, 0, 1_000) == [300, 600, 900, 1_000]
    assert checkpoint_steps(300, 600, 900) == [900]
    assert checkpoint_steps(300, 1_000, 1_000) == checkpoint_steps(0, 0, 1_000) == []


def test_a_checkpoint_follows_the_evaluation_of_its_step():
    recorder = Recorder(TRAIN)
    recorder.run(checkpoint_every=250)
    assert [(at.env_steps, at.evaluated) for at in recorder.saved] == [
        (250, 0), (500, 500), (750, 500), (1_000, 1_000), (1_250, 1_000), (1_500, 1_500), (1_750, 1_500), (2_000, 2_000)
    ]  # fmt: skip
    assert recorder.saved[-1].wall_seconds == pytest.approx(recorder.now)


def test_without_checkpoints_nothing_is_saved():
    recorder = Recorder(TRAIN)
    recorder.run(stop=lambda: recorder.done >= 1_100)
    assert recorder.saved == []


def test_an_interrupted_run_is_saved_before_its_last_report():
    recorder = Recorder(TRAIN)
    outcome = recorder.run(stop=lambda: recorder.done >= 1_100, checkpoint_every=1_000)
    last = recorder.saved[-1]
    assert (last.env_steps, last.evaluated) == (outcome.env_steps, 1_000)


@pytest.mark.parametrize(
    ("at", "evaluated", "left"), [(1_200, 1_000, [1_500, 2_000]), (1_000, 500, [1_000, 1_500, 2_000])]
)
def test_a_run_resumes_at_its_position(at, evaluated, left):
    recorder = Recorder(TRAIN)
    start = Position(at, evaluated, ((1, 800),), 7.0)
    outcome = recorder.run(start=start)
    assert [report.env_steps for report in recorder.reports] == left
    assert sum(steps for steps, _ in recorder.calls) == 2_000 - at
    assert outcome.diverged == {1: 800} and recorder.messages == []
    assert outcome.wall_seconds == pytest.approx(7 + recorder.now)
    assert all(np.isnan(report.returns[1]).all() for report in recorder.reports)


def test_if_only_the_last_evaluation_is_left_a_checkpoint_follows_it():
    recorder = Recorder(TRAIN)
    recorder.run(start=Position(2_000, 1_500), checkpoint_every=250)
    assert recorder.calls == [] and [report.env_steps for report in recorder.reports] == [2_000]
    assert [(at.env_steps, at.evaluated) for at in recorder.saved] == [(2_000, 2_000)]


def test_a_finished_run_does_not_change():
    recorder = Recorder(TRAIN)
    outcome = recorder.run(start=Position(2_000, 2_000, (), 5.0), checkpoint_every=250)
    assert recorder.calls == recorder.reports == recorder.saved == []
    assert (outcome.env_steps, outcome.interrupted) == (2_000, False)
