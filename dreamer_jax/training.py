"""A run: prefill, update, collect, evaluate, save (thesis algorithm 3).

What comes next is a function of a few counters (dreamer_jax.schedule), and every random number
derives from a member's seed and those counters. So a run that is stopped anywhere and resumed
from its last checkpoint gives the same metrics, byte for byte, as one that was not.

Axis letters: P population member, K task, B batch, L sequence length, T ticks in a phase.
"""

import contextlib
import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from dreamer_jax.agent import Agent, Mode
from dreamer_jax.ahead import PhaseAhead, on_thread
from dreamer_jax.device_round import DeviceRounds, on_device
from dreamer_jax.devices import Placement, on_one_device
from dreamer_jax.learning import AgentState
from dreamer_jax.locks import FolderLock
from dreamer_jax.population import Member, Population, check_environment
from dreamer_jax.progress import Progress
from dreamer_jax.record_checks import check_records
from dreamer_jax.records import Records
from dreamer_jax.run_folder import RunFolder
from dreamer_jax.run_rows import RunRows
from dreamer_jax.schedule import Counters, Schedule
from dreamer_jax.stopping import StopRequest
from dreamer_jax.waiting import to_host


class NonFiniteError(FloatingPointError):
    """All members of a population have met losses or gradients that are not finite."""


class Run:
    """One population in training, and the folder that holds it.

    Args:
      agent: the agent's functions; `agent.config` holds the schedule too.
      env: an environment of P * K slots (see `dreamer_jax.rollout`), with methods `check()`, which
        raises what its simulators met; perhaps `hurry()`, after which it waits for none long; and
        perhaps `rest(slots)`, which is told before each phase, by a mask bool [P * K], what need
        not be simulated: the slots of frozen members.
      tasks: the names of the K tasks.
      members: the P members.
      directory: metrics, checkpoints, replay and videos go here.
      state: agents to start from, leaves [P, ...]; fresh ones by default.
      resume: continue from the folder's newest checkpoint (or from the start if there is none).
      videos: how many of the evaluations are also written as videos, spread over the run.
      from_checkpoint: step of an older checkpoint to continue from; later ones are removed.
      lock: the folder's lock, if the caller holds it; it is released with the run.
      placement: where the members lie; by default all on one device. It is no part of what a run
        is: one may be resumed on other devices. With several, an environment must be one for them:
        its `shards` says how many.

    Raises:
      FolderInUseError: another process works in the folder.
      DamagedError, CorruptCheckpointError: what the folder holds is not what was written.
      FileExistsError: the folder holds a run, and `resume` is False.
      ValueError: sizes of the environment, the members and the state do not fit together.
    """

    def __init__(
        self,
        agent: Agent,
        env,
        tasks: tuple[str, ...],
        members: tuple[Member, ...],
        directory: str | Path,
        *,
        state: AgentState | None = None,
        resume: bool = False,
        videos: int = 10,
        from_checkpoint: int | None = None,
        lock: FolderLock | None = None,
        placement: Placement | None = None,
    ):
        config = agent.config
        placement = placement or on_one_device(len(members))
        if placement.members != len(members):
            raise ValueError(
                f"{placement.members} members are placed, {len(members)} are named: place as many"
            )
        check_environment(agent, env, placement)
        self.agent, self.env = agent, env
        self.tasks, self.members = tuple(tasks), tuple(members)
        self.directory = Path(directory)
        self.schedule = Schedule(config.schedule, len(self.tasks))
        self._place = on_device(
            agent, getattr(env, "has_host", True), len(self.tasks), placement.each
        )
        self.placement = placement
        own_seeds = [member.seed for member in self.members]
        self.population = Population(agent, env, len(self.tasks), own_seeds, placement)
        self.seeds = self.population.seeds
        self.folder = RunFolder(
            self.directory,
            lock=lock,
            resume=resume or from_checkpoint is not None,
            layout={
                "members": len(self.members),
                "tasks": len(self.tasks),
                "image_size": config.network.image_size,
                "action_size": agent.action_size,
                "keep": config.schedule.replay_keep,
                "threads": config.schedule.replay_threads,
            },
        )
        self.checkpoints, self.replay = self.folder.checkpoints, self.folder.replay
        self.writer = self.folder.writer
        self._rows = RunRows(self.writer, self.schedule, self.tasks, self.members, videos)
        try:
            self._start(state, from_checkpoint)
        except BaseException:
            self.folder.close()
            raise

    def _start(self, state: AgentState | None, from_checkpoint: int | None) -> None:
        """Takes up what the folder holds, or else the state given, or else fresh agents."""
        agent, population = self.agent, self.population
        # Where the replay is on the device; None where updates read the files.
        self.device_rounds = (
            DeviceRounds(agent, self.env, self.replay, population.own_seeds, self.placement)
            if self._place.device
            else None
        )
        self.counters = Counters()
        # What is collected beside updates and not committed yet.
        self._ahead: PhaseAhead | None = None
        if state is not None and state.updates.shape != (len(self.members),):
            raise ValueError(
                f"the state holds {state.updates.shape} members, {len(self.members)} are named"
            )
        if state is not None:
            self.state = population.put(state)
        else:
            # What goes on needs no agents that are then thrown away.
            begun = self.checkpoints.latest() is not None
            self.state = population.shapes() if begun else population.fresh()
        self.sums = population.zero_sums(self.state)
        self._restore(from_checkpoint)

    def _restore(self, step: int | None = None) -> None:
        """Goes back to a checkpoint, by default the newest, if there is one."""
        tree = self.placement.own_shapes({"agent": self.state, "sums": self.sums})
        put: Any = self.placement.spread if self.placement.count > 1 else None
        found = self.folder.restore(tree, step, put)
        if found is not None:
            self.state = self.population.without_padding(found[0]["agent"])
            self.sums = found[0]["sums"]
            self.counters = Counters(**found[1])
        self._healthy = np.array(self.placement.own(self.state.healthy))

    def save(self) -> None:
        """Writes a checkpoint of everything that a resumed run needs."""
        tree = self.placement.own({"agent": self.state, "sums": self.sums})
        self.folder.save(self._step(), tree, dataclasses.asdict(self.counters))
        self._saved_steps = self.schedule.environment_steps(self.counters.rounds)

    def _save_if_due(self) -> None:
        every = self.schedule.config.checkpoint_every
        steps = self.schedule.environment_steps(self.counters.rounds)
        if steps // every > self._saved_steps // every:
            self.save()

    def _step(self) -> int:
        """A number that grows with every action."""
        return self.counters.rounds + self.counters.updates + self.counters.evaluations

    # The loop.

    def train(self) -> Literal["finished", "stopped"]:
        """Runs until the schedule is done or a stop is requested, and saves.

        Returns:
          "finished", or "stopped" after Ctrl-C: `resume` continues.

        Raises:
          NonFiniteError: no member is healthy any more; what was collected is saved.
          Exception: what a simulator met; the run is saved as it was before that phase, and before
            the updates beside it.
        """
        schedule = self.schedule
        with (
            self._progress_bar() as self._bar,
            StopRequest(self._bar.message, getattr(self.env, "hurry", lambda: None)) as stop,
        ):
            for note in (self._devices_note(), self._place.note):
                if note:
                    self._bar.message(note)
            if self.checkpoints.latest() is None:
                self.save()
            self._saved_steps = schedule.environment_steps(self.counters.rounds)
            # A phase that is collected ahead belongs to its round: both are done, or none is.
            while (action := schedule.next(self.counters)) != "done" and (
                self._ahead or not stop.requested
            ):
                ahead = self._ahead is not None
                if action == "collect" and not ahead:
                    self._save_if_due()
                try:
                    if action == "update":
                        self._update(stop)
                    elif action == "evaluate":
                        self._evaluate()
                    else:
                        self._round("random" if action == "prefill" else "explore")
                except (KeyboardInterrupt, NonFiniteError):
                    raise
                except Exception as error:
                    # Nothing of the failed action has been committed.
                    self._take_back()
                    self.save()
                    if not stop.requested:
                        raise
                    self._bar.message(f"this phase is given up: {error}")
                    return "stopped"
                if action == "collect" and ahead:
                    self._save_if_due()
            self.save()
        return "finished" if action == "done" else "stopped"

    def close(self) -> None:
        """Closes the folder. The environment belongs to the caller."""
        self.folder.close()

    def _devices_note(self) -> str:
        """What devices are used, where there is a choice."""
        return str(self.placement) if self.placement.available > 1 else ""

    def _progress_bar(self) -> Progress:
        return Progress(
            total_env_steps=self.schedule.environment_steps(self.schedule.rounds),
            total_updates=self.schedule.updates,
            env_steps=self.schedule.environment_steps(self.counters.rounds),
            updates=self.counters.updates,
            description=self.directory.name,
        )

    def _phase(self, mode: Mode, phase: int) -> Records:
        self._let_rest()
        return self._played(self.state, mode, phase)

    def _let_rest(self) -> None:
        if hasattr(self.env, "rest"):
            # A frozen member learns nothing from what it would play.
            self.env.rest(np.repeat(~self._healthy, len(self.tasks)))

    def _played(self, state: AgentState, mode: Mode, phase: int) -> Records:
        started = time.perf_counter()
        records = to_host(self.population.collect(state, phase, mode))
        records = self.placement.own(records)
        self.env.check()
        check_records(records, self.tasks, self._healthy)
        what = "evaluate" if mode == "evaluate" else "collect"
        self._rows.timed(what, time.perf_counter() - started, self.counters)
        return records

    def _round(self, mode: Literal["random", "explore"]) -> None:
        """Collects, or takes what was collected ahead; and in one program with that makes the
        updates that are then due, if rounds are one program each."""
        if self._ahead is not None:
            self._commit(self._ahead.records.result(), mode)
            self._ahead = None
            return
        self._bar.update(phase="collecting at random" if mode == "random" else "collecting")
        if not self._place.one_program:
            self._commit(self._phase(mode, self.counters.rounds), mode)
            return
        started, rounds = time.perf_counter(), self.counters.rounds
        updates = range(self.counters.updates, self.schedule.updates_due(rounds + 1))
        with self._used_up() as device_rounds:
            self.state, self.sums, records = device_rounds.run(
                self.state, self.sums, rounds, updates, mode
            )
            self.env.check()
            check_records(records, self.tasks, self._healthy)
            seconds = time.perf_counter() - started
            self._rows.timed("round", seconds, self.counters, updates=len(updates))
            self._commit(records, mode)
        if updates:
            self._updated(updates)
            self._write_averages()

    @contextlib.contextmanager
    def _used_up(self) -> Iterator[DeviceRounds]:
        """For programs that use up the agents: should one fail, those that are kept, or else those
        of the newest checkpoint, are taken up."""
        assert self.device_rounds is not None
        try:
            yield self.device_rounds
        except Exception:
            self.device_rounds.forget()
            if self._ahead is None:
                self._restore()
            else:
                self._take_back()
            raise

    def _collect_ahead(self) -> PhaseAhead:
        """Begins to collect the next phase, with the policy as it is."""
        state, sums = self.population.copied((self.state, self.sums))
        self._let_rest()
        records = on_thread(self._played, state, "explore", self.counters.rounds)
        offset = self.writer.offset()
        return PhaseAhead(records, state, sums, self.counters, self._healthy, offset)

    def _take_back(self) -> None:
        """Makes the run what it was before a phase that is collected ahead, if there is one."""
        ahead, self._ahead = self._ahead, None
        if ahead is not None:
            ahead.wait()
            self.state, self.sums, self.counters = ahead.state, ahead.sums, ahead.counters
            self._healthy = ahead.healthy
            self.writer.truncate(ahead.metrics)

    def _commit(self, records: Records, policy: Literal["random", "explore"]) -> None:
        """Writes a phase to the replay, and what it brought to the metrics."""
        rounds = self.counters.rounds + 1
        self.replay.append(records)
        counters = dataclasses.replace(self.counters, rounds=rounds)
        score = self._rows.collected(records, policy, counters, self._healthy)
        self.counters = counters
        self._bar.update(env_steps=self.schedule.environment_steps(rounds), last_return=score)

    def _update(self, stop: StopRequest) -> None:
        """Makes the updates that are due, perhaps with the next phase collected beside them; from
        files and without a phase, those until a stop is requested."""
        rounds, schedule = self.counters.rounds, self.schedule
        # The first phase after the random ones is for a policy that has been trained.
        if (
            schedule.config.collect == "beside"
            and schedule.prefill_rounds < rounds < schedule.rounds
        ):
            self._bar.update(phase="updating and collecting")
            self._ahead = self._collect_ahead()
        else:
            self._bar.update(phase="updating")
        started, before = time.perf_counter(), self.counters.updates
        due = range(before, self.schedule.updates_due(self.counters.rounds))
        if self._place.device:
            with self._used_up() as device_rounds:
                self.state, self.sums = device_rounds.update(self.state, self.sums, due)
            self._updated(due)
        else:
            self._update_from_files(due, stop)
        made, seconds = self.counters.updates - before, time.perf_counter() - started
        if self._ahead is not None:
            self._ahead.records.result()
        self._rows.timed("update", seconds, self.counters, updates=made)
        if made == len(due):
            self._write_averages()

    def _update_from_files(self, due: range, stop: StopRequest) -> None:
        """Makes updates, one batch after the other, until a stop is requested; or, with a phase
        beside them, until that has failed."""
        learning = self.agent.config.learning
        loss: jax.Array | None = None
        with self.replay.batches(
            self.population.own_seeds, due, learning.batch_size, learning.sequence_length
        ) as batches:
            for update, batch in zip(due, batches, strict=True):
                previous = loss
                self.state, self.sums, loss = self.population.update(self.state, self.sums, batch)
                # One update ahead of the device, no more: the next batch is being prepared.
                jax.block_until_ready(previous)
                self._updated(range(update, update + 1))
                if stop.requested if self._ahead is None else self._ahead.failed:
                    break
        jax.block_until_ready(loss)

    def _updated(self, updates: range) -> None:
        """Counts updates with these numbers, which have been made."""
        averaged = self.counters.averaged + len(updates)
        self.counters = dataclasses.replace(self.counters, updates=updates.stop, averaged=averaged)
        self._bar.update(updates=updates.stop)

    def _write_averages(self) -> None:
        count, sums = self.counters.averaged, jax.device_get(self.sums)
        healthy = np.array(self.placement.own(self.state.healthy))
        newly_frozen = np.flatnonzero(self._healthy & ~healthy).tolist()
        self._healthy = healthy
        averages = {name: np.asarray(x, np.float64) / count for name, x in sums.items()}
        learning, say = self.agent.config.learning, self._bar.message
        self._rows.updated(averages, self.counters, healthy, learning, say)
        for member in newly_frozen:
            say(
                f"{self._rows.named(member)} met a loss or gradient that is not finite by update "
                f"{self.counters.updates}: it is frozen as it was before, the others go on"
            )
        self.sums = jax.tree.map(jnp.zeros_like, self.sums)
        self.counters = dataclasses.replace(self.counters, averaged=0)
        if not self._healthy.any():
            self.save()
            raise NonFiniteError(
                f"no member of {self.directory} has finite losses any more; lower the learning "
                "rates or the gradient norm. The last healthy parameters are in its checkpoint"
            )

    def _evaluate(self) -> None:
        """One episode per task and member: the mode, without noise, up to the first fall."""
        self._bar.update(phase="evaluating")
        index = self.counters.evaluations + 1
        records = self._phase("evaluate", index)
        diagnosis = jax.device_get(self.population.diagnose(self.state.params, records, index))
        score = self._rows.evaluated(records, diagnosis, self.counters, self._healthy)
        # A long round may cross several multiples; they share one evaluation.
        steps = self.schedule.environment_steps(self.counters.rounds)
        evaluations = steps // self.schedule.config.evaluate_every
        self.counters = dataclasses.replace(self.counters, evaluations=evaluations)
        self._bar.update(last_return=score)
