"""One process's part of a run: from the command line's options to the exit code."""

import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.commandline.arguments import (
    DIVERGED,
    DONE,
    FAILED,
    INTERRUPTED,
    UsageError,
    printable,
)
from experiments.running import (
    environment_errors,
    files,
    folder_lock,
    manifests,
    records,
    resume,
    run_config,
    wandb_runs,
)
from experiments.running.announce import Announcer
from experiments.running.checkpoints import CheckpointStore, Restored
from experiments.running.csv_rows import MissingRows, WrongColumns
from experiments.running.loop import START, Outcome, Position, train_loop
from experiments.running.plan import Plan, name_taken, not_only_a_run
from experiments.running.progress import Display
from experiments.running.run_config import Member
from experiments.running.run_policies import RunPolicies
from experiments.running.signals import stop_on_signal
from experiments.surroundings.consoles import console
from sqt_jax.experiment import make_trainer, replay_of
from sqt_jax.one_line import one_line
from sqt_jax.policy_folders import BEST, LAST
from sqt_jax.train import TrainState, make_sweep
from sqt_jax.types import Array, HostError, Scalars


def start_session(plan: Plan, command: Sequence[str]) -> "Session":
    """The session of a plan. Raises `UsageError` if the run's folder cannot be made.

    A run without a --name gets a folder of its own, also if another process chose the same name at the same time.
    """
    if plan.options.name is None and plan.resumed is None:
        try:
            plan = plan._replace(path=files.new_folder(plan.path))
        except OSError as error:
            raise _cannot_write(plan, error) from None
    return Session(plan, command)


class Session:
    """Holds the parts of a run (sweep, checkpoints, tables, display) and trains it to its end or to a signal.

    Args:
      plan: what to train and where.
      command: the command line, for config.json.
    """

    def __init__(self, plan: Plan, command: Sequence[str]):
        self.plan, self.command = plan, command
        self.path = plan.path.absolute()  # an environment on the host may change the current folder
        self.console = console()
        self.display = Display(self.console, plan.train.steps, quiet=plan.options.quiet)
        self.announcer = Announcer(self.console, plan)
        trainer = make_trainer(plan.config, plan.given_env)
        self.sweep = make_sweep(trainer, plan.layout)
        self.init_arguments = _init_arguments(plan.members)
        # Shapes of the members only: with a layout, a state has padding too.
        self.template = jax.eval_shape(make_sweep(trainer).init, *self.init_arguments)
        self.store = CheckpointStore(
            self.path / "checkpoint",
            replay_of(plan.config, plan.env),
            plan.layout,
            plan.output["keep_checkpoints"],
            self.display.message,
        )
        self.policies = RunPolicies(plan.config, plan.env, len(plan.members))
        self.restored: Restored | None = None  # the checkpoint that training resumes from

    def run(self) -> int:
        """Restores, trains and writes the results; returns the exit code.

        Raises:
          UsageError: the run cannot be started or resumed. Nothing in an existing folder has changed then.
        """
        with ExitStack() as stack:
            stack.enter_context(self._locked())
            stack.enter_context(self.display)
            received = stack.enter_context(stop_on_signal())
            if self.plan.env.host:
                stack.callback(self.plan.env.host.close)
            stack.callback(self.store.wait)
            # A new run writes its config.json first, so that it can be resumed from then on. An existing run is not
            # changed before it is certain that it can be resumed.
            if self.plan.resumed:
                self.restored = self._restore()
                if self.restored and self._is_finished(self.restored.position):
                    self.announcer.already_finished()
                    return DIVERGED if self.restored.position.diverged else DONE
            else:
                self._claim()
            tables = stack.enter_context(self._open_tables())
            if self.plan.resumed:
                self._record_resumption(self.plan.resumed)
                self.store.remove_others()
            tracked = self._track(tables)
            resumed_at = self.restored.position.env_steps if self.restored else None
            state_bytes, row_bytes = self.store.sizes(self.template)
            state_bytes += self.policies.bytes_in_checkpoint(self.template.agent)
            self.announcer.start(resumed_at, (state_bytes, row_bytes), tracked)
            outcome = self._train(tables, lambda: bool(received))
            try:
                curves = self._write_results(outcome)
                summary = tables.summary(outcome)  # last: its existence says that the run has ended
            except OSError as error:
                print(printable(f"the results cannot be written: {error}"), file=sys.stderr)
                return FAILED

        self.announcer.end(outcome, summary, tables.swept, curves)
        if line := environment_errors.unstable_steps(self.plan.env, outcome.state.timestep):
            self.display.message(line)
        if failure := self._environment_error():
            return self._report_failure(failure)
        return INTERRUPTED if outcome.interrupted else DIVERGED if outcome.diverged else DONE

    def _environment_error(self) -> HostError | None:
        """The exception of an environment on the host that ended the run."""
        return self.plan.env.host.error() if self.plan.env.host else None

    def _report_failure(self, error: HostError) -> int:
        """Writes the traceback to a file and prints the error in one line; returns the exit code."""
        where, newest = environment_errors.write_error(self.path, self.plan.path, error), self.store.newest()
        saved = "there is no checkpoint" if newest is None else f"the last checkpoint is of step {newest:,}"
        print(printable(f"--env={self.plan.config.env}: {error.text}; {where}; {saved}"), file=sys.stderr)
        return FAILED

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Keeps other processes out of the run's folder."""
        path, resumed = self.plan.path, self.plan.resumed
        with ExitStack() as stack:
            try:
                stack.enter_context(folder_lock.locked(self.path, self.display.message))
            except folder_lock.Busy as busy:
                flag = f"--resume={path}" if resumed else f"--name={path.name}"
                raise UsageError(f"{flag}: {busy} is training {path}; expects another run") from None
            except OSError as error:
                raise _cannot_write(self.plan, error) from None
            yield

    def _restore(self) -> Restored | None:
        """The latest valid checkpoint; None: the run has none yet and starts at step 0."""
        assert self.plan.resumed
        try:
            restored = self.store.restore(self.template)
            if restored:
                self.policies.restore(restored.folder)
        except manifests.CannotResume as error:
            raise UsageError(f"--resume={self.plan.path}: {resume.EXPECTS_CHECKPOINTS}; {error}") from None
        if restored is None:
            resume.check_may_restart(self.plan.path, self.plan.resumed.content["output"].get("checkpoint_every"))
        return restored

    def _is_finished(self, at: Position) -> bool:
        """Whether all steps, evaluations and results exist: then summary.json is not written again."""
        results = self._summary.exists() and all((self.path / name).is_dir() for name in (LAST, BEST))
        return at.env_steps == at.evaluated == self.plan.train.steps and results

    @property
    def _summary(self) -> Path:
        return self.path / "summary.json"

    def _claim(self) -> None:
        """Makes the folder a run by writing config.json, after removing an existing run if --overwrite allows it."""
        plan = self.plan
        try:
            if plan.options.overwrite:
                records.remove_run(plan.path)
            if records.is_taken(plan.path):
                raise name_taken(plan.path)
            content = run_config.new_content(
                plan.members,
                plan.swept,
                self.command,
                plan.options.preset,
                plan.output,
                plan.own_env,
                len(plan.layout.devices),
                plan.env.version,
            )
            run_config.write(self.path, content)
        except records.NotARun:
            raise not_only_a_run(plan.path) from None
        except OSError as error:
            raise _cannot_write(self.plan, error) from None

    def _record_resumption(self, run: run_config.RunConfig) -> None:
        """Adds this process to config.json. Removes summary.json, which says that the run has ended, and its policies.

        Until it ends again, its policies are those of its checkpoints.
        """
        plan = self.plan
        at = self.restored.position.env_steps if self.restored else 0
        try:
            content = run_config.resumed_content(
                run.content, plan.train.steps, plan.output, at, self.command, len(plan.layout.devices)
            )
            run_config.write(self.path, content)
            self._summary.unlink(missing_ok=True)
            (self.path / environment_errors.FILE).unlink(missing_ok=True)
            for name in (LAST, BEST):
                shutil.rmtree(self.path / name, ignore_errors=True)
        except OSError as error:
            raise _cannot_write(self.plan, error) from None

    def _open_tables(self) -> records.Records:
        """The run's tables: empty ones, or those of a resumed run, cut to their length at its checkpoint."""
        plan = self.plan
        resumed_at = None
        if plan.resumed:
            restored = self.restored
            resumed_at = (restored.position.env_steps, restored.lengths) if restored else (-1, {})
        try:
            return records.Records(
                self.path, plan.members, plan.swept, plan.output["tensorboard"], resumed_at, self.display.message
            )
        except MissingRows as error:
            raise UsageError(
                f"--resume={plan.path}: {error} has lost rows since the checkpoint; expects a run with complete tables"
            ) from None
        except WrongColumns as error:
            raise UsageError(
                f"--resume={plan.path}: expects a run of this version; {error} has other columns"
            ) from None
        except OSError as error:
            raise _cannot_write(self.plan, error) from None

    def _track(self, tables: records.Records) -> str:
        """Starts to send the rows to Weights & Biases, if --wandb asks for it; returns a line that says where."""
        plan = self.plan
        runs = wandb_runs.open_runs(self.path, plan.members, tables.swept, plan.output["wandb"], self.display.message)
        if runs:
            tables.track(runs)
        return runs.where if runs else ""

    def _train(self, tables: records.Records, stop: Callable[[], bool]) -> Outcome:
        def save(state: TrainState, position: Position) -> None:
            try:
                lengths = tables.lengths()
            except OSError as error:
                self.display.message(
                    f"no checkpoint at step {position.env_steps:,} ({error.strerror}); training continues"
                )
                return
            self.store.save(state, position, lengths, self.policies.writer(state.agent))

        def evaluated_at(state: TrainState, env_steps: int, returns: np.ndarray) -> None:
            self.policies.evaluated(state.agent, env_steps, returns)

        if self.restored:
            host = self.plan.env.host
            first = self.sweep.restart(self.restored.state) if host else self.restored.state
        else:
            first = self.sweep.init(*self.init_arguments)
            self.policies.start(first.agent)
        outcome = train_loop(
            self.sweep,
            first,
            self.plan.train,
            len(self.plan.members),
            report=tables.report,
            display=self.display,
            stop=stop,
            failed=lambda: self._environment_error() is not None,
            keeps_failed=not self.plan.layout.spread,
            start=self.restored.position if self.restored else START,
            checkpoint_every=self.plan.output["checkpoint_every"],
            save=save,
            evaluated_at=evaluated_at,
        )
        self.store.wait()
        return outcome

    def _write_results(self, outcome: Outcome) -> bool:
        """Writes the policies and, if there are evaluations, curves.png; returns whether there are."""
        plan = self.plan
        self.policies.write_results(self.path, outcome.state.agent)
        table = records.read_evaluations(self.path / "evaluations.csv")
        if not len(table["member"]):
            return False
        try:
            # Here, so that a matplotlib that cannot be imported costs a figure, not the run.
            from experiments.evidence import figures

            figures.draw_curves(table, self.path / "curves.png", f"{plan.config.algo} on {plan.config.env}")
        except Exception as error:  # of any type: no fault of a figure may cost the summary
            self.display.message(f"no curves.png: {one_line(error)}; experiments.plots draws it later")
            return False
        return True


def _cannot_write(plan: Plan, error: OSError) -> UsageError:
    flag = f"--resume={plan.path}" if plan.resumed else f"--out={plan.options.out}"
    return UsageError(f"{flag}: expects a folder that can be written: {error}")


def _init_arguments(members: Sequence[Member]) -> tuple[Array, Scalars]:
    """The members' keys [S] and scalars [S], for `Sweep.init`."""
    seeds = jnp.array([member.seed for member in members], jnp.uint32)
    agents = [member.config.agent for member in members]
    scalars = (jnp.array([getattr(agent, name) for agent in agents], jnp.float32) for name in Scalars._fields)
    return jax.vmap(jax.random.key)(seeds), Scalars(*scalars)
