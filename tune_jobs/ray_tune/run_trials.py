"""Run a sweep's trials with Ray Tune, and keep their records up to date.

Tune decides which trial runs where and when; what a trial is and how far it got is in the sweep folder, written here
(their records) and by the trials' own processes. Tune's own folder is a cache that every run begins anew.
"""

from __future__ import annotations

import contextlib
import functools
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from ray import tune
from ray.tune.experiment import Trial
from ray.tune.schedulers import TrialScheduler
from ray.tune.search import SearchAlgorithm, Searcher

from policies.envs.modules import module_folders
from policies.errors import CannotRunError
from policies.parents import this_process
from tune_jobs.plan.engine_choice import PackPlan
from tune_jobs.process.clock import passing_s
from tune_jobs.process.interruption import EXIT_CODE, current, last_words
from tune_jobs.process.ran_with import versions
from tune_jobs.ray_tune.connected_ray import is_of_a_sweep
from tune_jobs.ray_tune.early_stopping import build_tune_scheduler
from tune_jobs.ray_tune.environment import prepare_environment
from tune_jobs.ray_tune.failures import going_on
from tune_jobs.ray_tune.hyperband import HyperBandScheduler
from tune_jobs.ray_tune.lean import lean_run
from tune_jobs.ray_tune.lost_nodes import NodeLosses
from tune_jobs.ray_tune.meetings import compared_with
from tune_jobs.ray_tune.pack_driver import PackDriver
from tune_jobs.ray_tune.pack_scheduler import PackScheduler
from tune_jobs.ray_tune.pack_trainable import PackTrainable
from tune_jobs.ray_tune.population import PopulationScheduler
from tune_jobs.ray_tune.processes import RayDiedError, RayWatch, ray_died
from tune_jobs.ray_tune.reporter import reporter
from tune_jobs.ray_tune.run_waits import RunWaits
from tune_jobs.ray_tune.scheduling import EveryoneGoesOn
from tune_jobs.ray_tune.searcher import PointChooser, PointSearcher, TrialsInOrder
from tune_jobs.ray_tune.trainable import TrialTrainable
from tune_jobs.ray_tune.tune_events import PackEvents, TrialEvents, pack_id_of, trial_id_of
from tune_jobs.ray_tune.tune_scheduler import TuneScheduler
from tune_jobs.search.comparisons import comparisons_before
from tune_jobs.search.gains import Evaluations
from tune_jobs.search.rungs import TAKE_RUNGS
from tune_jobs.spec.file import stored_spec
from tune_jobs.spec.sweep_spec import SweepSpec
from tune_jobs.store.contract import Ownership, Sweep
from tune_jobs.store.copies import remove_uncounted_copies
from tune_jobs.store.opening import open_sweep, resume_command
from tune_jobs.store.ownership import OwnershipLostError
from tune_jobs.store.record_keeper import Listener, RecordKeeper
from tune_jobs.store.storage_watch import StorageWatch

# How long running trials may take to save a checkpoint after they were asked to stop, before they are ended.
STOP_GRACE_S = 20.0


@dataclass(frozen=True)
class RunJob:
    """The trials that a run has to run."""

    sweep_place: str
    """The sweep's place, for `open_sweep`."""
    trial_ids: tuple[str, ...]
    cpus_per_trial: float
    gpus_per_trial: float
    max_concurrent: int
    packs: PackPlan | None = None
    """How the packed trials are run; None: no trial is packed."""
    more_packs: int = 0
    """The most packs beside those of the plan, for nodes that join."""
    run: str | None = None
    """The run's token, as in `Owner`; None: the job makes one."""


def run_trials(job: RunJob, listener: Listener) -> None:
    """Run trials to their end, or until the sweep is asked to stop. Failed trials raise no error.

    Args:
        job: The trials to run; this process must be connected to Ray.
        listener: Called with a trial's record whenever it changes, in this thread.

    Raises:
        OwnershipLostError: Another process runs the sweep by now; nothing was written over its records.
        CannotRunError: A part of Ray died though nobody had asked for the end; the records are written.
    """
    prepare_environment()
    store = open_sweep(job.sweep_place)
    owner = store.take() if job.run is None else store.owner(job.run)
    with owner.held():
        store.clear_tune_folder()
        # Only population based training makes copies.
        record = store.read_record()
        if stored_spec(record).scheduler.is_population:
            with store.reading(results=False):
                for trial_id in job.trial_ids:
                    remove_uncounted_copies(store.trial(trial_id), store.trial(trial_id).read_record().changes)
    # Asked now, as the storage may be gone when it is told.
    go_on = resume_command(store, record)
    with RayWatch.of_this_process() as watch:
        run = _Run(job, store, listener, owner, watch)
        # Asked here, as only the main thread is told; Ray may be what keeps it from being told in time.
        arrived = current().has_arrived
        watch.hurries = lambda: arrived() or run.keeper.stop_requested()
        watch.when_stuck = functools.partial(_give_up, run, watch, go_on)
        try:
            run.all_trials()
        except (RayDiedError, Exception) as error:
            death = _death_behind(error, watch)
            if death is None:
                with _saying_how_to_go_on(go_on):
                    raise
            # A signal that asks for the end may have been sent to Ray's processes, too, which ended sooner.
            if not watch.hurries():
                raise ray_died(go_on, death) from error
        finally:
            # What ended the run may keep the last records from being written too, and is told in this way then.
            with current().shielded(), _saying_how_to_go_on(go_on):
                with contextlib.suppress(OwnershipLostError):
                    run.waits.end()
                run.keeper.close()
                owner.release()


def _death_behind(error: BaseException, watch: RayWatch) -> RayDiedError | None:
    """Return the death of a part of Ray that caused an error, or None: those that Ray raises do not name the cause."""
    if isinstance(error, RayDiedError):
        return error
    try:
        watch.check_after(error)
    except RayDiedError as death:
        return death
    return None


@contextlib.contextmanager
def _saying_how_to_go_on(command: str) -> Iterator[None]:
    try:
        yield
    except CannotRunError as error:
        if type(error) is not CannotRunError:
            raise
        # The storage, say, can't be written any more.
        raise going_on(error, command) from error


class _Run:
    """A run of packed and single trials, which share their records, their scheduler and the choice of points."""

    def __init__(self, job: RunJob, store: Sweep, listener: Listener, owner: Ownership, watch: RayWatch) -> None:
        self._job = job
        self._watch = watch
        self._store = self.store = store
        self._record = store.read_record()
        self._began_s = passing_s()
        # The settings of every process: its sweep, its run, the driver with which it ends, and what its node must have.
        self._config: dict[str, Any] = {"sweep_place": store.place, "run": owner.token, "driver": this_process()}
        if self._record.address is not None:
            # As one text: Tune copies the settings of each trial some times, part by part.
            self._config["versions"] = json.dumps(versions())
        if not is_of_a_sweep() and (folders := module_folders()):
            # What a sweep starts Ray with has them on its path; a user's may have been started before they were there.
            self._config["folders"] = json.dumps(folders)
        self._spec = stored_spec(self._record)
        self.keeper = RecordKeeper(store, job.trial_ids, listener, run=owner)
        self.waits = RunWaits(store, self.keeper)
        self._scheduler: TrialScheduler = TuneScheduler(EveryoneGoesOn())
        self._chooser: PointChooser | None = None

    def time_s(self) -> float:
        """Return how long the sweep has been run, by this run and all before it."""
        return self._record.run_time_s + passing_s() - self._began_s

    def all_trials(self) -> None:
        """Run all trials: those of the search first, then the further seeds of some of its points."""
        spec = self._spec
        searched: list[str] = []
        replicas: list[str] = []
        for name in self._job.trial_ids:
            is_replica = self.keeper.record(name).seed_index >= spec.seeds_per_point
            (replicas if is_replica else searched).append(name)
        if searched:
            self._scheduler = self._build_scheduler()
            if spec.search.has_model:
                ends_early = spec.scheduler.type != "none" and spec.objective.cost is None
                reads = ends_early and spec.search.type in TAKE_RUNGS
                curves = Evaluations(self._store) if reads else None
                self._chooser = PointChooser(spec, self._record, self.keeper.all_records, self.keeper.change, curves)
            self._stage(searched, "")
        if replicas and not (searched and self.keeper.stop_requested()):
            # They show what a setting gives when it is trained to the end: none of them is compared and ended.
            self._scheduler, self._chooser = TuneScheduler(EveryoneGoesOn()), None
            self._stage(replicas, "-of-replicas")

    def _stage(self, trial_ids: Sequence[str], suffix: str) -> None:
        plan = self._job.packs
        in_packs = [] if plan is None else plan.trial_ids
        # Sets, as of thousands of trials each is looked up.
        in_stage, is_packed = set(trial_ids), set(in_packs)
        packed = [name for name in in_packs if name in in_stage]
        others = [name for name in trial_ids if name not in is_packed]
        if packed:
            self._packs(packed, f"packs{suffix}")
        # Packs first, then single trials, because a pack uses all its CPUs all the time.
        if others and not (packed and self.keeper.stop_requested()):
            self._single_trials(others, f"run{suffix}")

    def _build_scheduler(self) -> TrialScheduler:
        if self._spec.scheduler.is_population:
            keeper = self.keeper
            before = comparisons_before(self._store, self._spec, list(map(keeper.record, self._job.trial_ids)))
            return PopulationScheduler(
                self._spec, self._store, keeper.record, keeper.change, all_records=keeper.all_records, before=before
            )
        return build_tune_scheduler(self._spec.scheduler, self._spec.stop.num_env_steps)

    def _packs(self, trial_ids: Sequence[str], folder: str) -> None:
        """Run trials in packs; for Tune, each pack is one trial."""
        plan = self._job.packs
        assert plan is not None
        # Single trials are compared with the packed ones.
        assert isinstance(self._scheduler, TuneScheduler)
        choose = None if self._chooser is None else self._chooser.prepare
        rule = self._scheduler.scheduler
        driver = PackDriver(
            self._store, self._spec, plan, trial_ids, scheduler=rule, keeper=self.keeper, choose=choose,
            more_packs=self._job.more_packs,
        )  # fmt: skip
        losses = NodeLosses(lambda trial: driver.reached(pack_id_of(trial)), self._watch.check_after)
        events = PackEvents(driver, self.keeper, self._spec.iteration_timeout_s, self._watch, losses)
        bundle = {"CPU": plan.cpus_per_pack} | ({"GPU": plan.gpus_per_pack} if plan.gpus_per_pack else {})
        self.waits.resources = bundle
        tuner = tune.Tuner(
            tune.with_resources(PackTrainable, tune.PlacementGroupFactory([bundle])),
            param_space={
                **self._config,
                "pack_id": tune.grid_search(list(driver.pack_ids)),
                # All packs of a sweep have the same engine, which the members' records name.
                "engine": self.keeper.record(trial_ids[0]).engine,
                "env_kind": plan.env_kind,
                "num_env_processes": plan.num_env_processes,
            },
            tune_config=tune.TuneConfig(
                scheduler=PackScheduler(driver), trial_name_creator=pack_id_of, trial_dirname_creator=pack_id_of
            ),
            # The driver decides which of a dead pack's trials are retried, and the run ends when none is left.
            run_config=self._run_config(folder, events, -1, lambda: driver.is_finished),
        )
        with losses.not_counted(), lean_run():
            tuner.fit()

    def _single_trials(self, trial_ids: Sequence[str], folder: str) -> None:
        """Run single trials, as many at once as fit."""
        spec, job = self._spec, self._job
        param_space: dict[str, Any] = dict(self._config)
        if isinstance(self._scheduler, HyperBandScheduler):
            todo = set(trial_ids)
            self._scheduler.begin(compared_with(todo, self.keeper.all_records(), spec.seeds_per_point), todo)
        losses = NodeLosses(self._reached, self._watch.check_after)
        events = TrialEvents(self._store, self.keeper, spec.iteration_timeout_s, self._watch, losses)
        resources = _resources(spec, job)
        self.waits.resources = resources.required_resources
        # Tune counts paused trials as running: the others would never start, and only those few would be compared.
        at_once = None if spec.scheduler.waits_for_others else job.max_concurrent
        searcher: Searcher | SearchAlgorithm
        if self._chooser is not None:
            searcher = PointSearcher(trial_ids, self._chooser)
        else:
            searcher = TrialsInOrder(trial_ids, max_concurrent=at_once or 0)
        tuner = tune.Tuner(
            tune.with_resources(TrialTrainable, resources),
            param_space=param_space,
            tune_config=tune.TuneConfig(
                search_alg=searcher,
                num_samples=len(trial_ids),
                scheduler=self._scheduler,
                # Without this setting Tune runs one trial at a time if there is a searcher that is not its own.
                max_concurrent_trials=None if self._chooser is None else at_once,
                reuse_actors=True,
                trial_name_creator=trial_id_of,
                trial_dirname_creator=trial_id_of,
            ),
            run_config=self._run_config(folder, events, spec.max_retries),
        )
        with losses.not_counted(), lean_run():
            tuner.fit()

    def _reached(self, trial: Trial) -> int:
        return max(self._store.trial(trial_id_of(trial)).checkpoint_iterations(), default=0)

    def _run_config(
        self, name: str, events: tune.Callback, max_failures: int, is_finished: Callable[[], bool] = lambda: False
    ) -> tune.RunConfig:
        return tune.RunConfig(
            name=name,
            storage_path=str(self._store.tune_folder),
            stop=_StopWhenAsked(self._store, self.keeper, is_finished, self._watch, self.waits),
            verbose=0,
            progress_reporter=reporter(),
            failure_config=tune.FailureConfig(max_failures=max_failures),
            # Trials write their own checkpoints; Tune's are pointers, made when it pauses one.
            checkpoint_config=tune.CheckpointConfig(checkpoint_frequency=0, checkpoint_at_end=False),
            callbacks=[events],
        )


def _resources(spec: SweepSpec, job: RunJob) -> tune.PlacementGroupFactory:
    """Return one bundle for the trial's process and one for each env runner; together they have `cpus_per_trial`."""
    num_runners = spec.resources.num_env_runners
    main = {"CPU": job.cpus_per_trial - num_runners}
    if job.gpus_per_trial:
        main["GPU"] = job.gpus_per_trial
    return tune.PlacementGroupFactory([main] + [{"CPU": 1}] * num_runners, strategy="PACK")


class _StopWhenAsked(tune.Stopper):  # type: ignore[misc]
    """Ends the run when nothing is left to do, or when it is asked to stop and trials have saved or took too long."""

    def __init__(
        self, store: Sweep, keeper: RecordKeeper, is_finished: Callable[[], bool], watch: RayWatch, waits: RunWaits
    ) -> None:
        self._watch = watch
        self._waits = waits
        self._store = store
        self._keeper = keeper
        self._is_finished = is_finished
        self._asked_at: float | None = None
        self._storage = StorageWatch(store)

    def __call__(self, trial_id: str, result: dict[str, Any]) -> bool:  # noqa: ARG002 (the signature of Tune's stoppers)
        return False

    def stop_all(self) -> bool:
        """Whether to end the run now; Tune asks this continually.

        Raises:
            RayDiedError: A part of Ray is gone.
            CannotRunError: The storage is.
            OwnershipLostError: Another process runs the sweep by now.
        """
        self._watch.check()
        self._storage.check()
        self._waits.look()
        if self._is_finished():
            return True
        if self._asked_at is None:
            if not self._keeper.stop_requested():
                return False
            self._asked_at = time.monotonic()
        return not self._keeper.running or time.monotonic() - self._asked_at > STOP_GRACE_S


def _give_up(run: _Run, watch: RayWatch, go_on: str, death: RayDiedError) -> None:
    """Save the records and end this process, whose main thread waits for Ray; Ray would end it within a minute.

    This is done in the background because the main thread is blocked, so it cannot change anything meanwhile.
    """
    from tune_jobs.store.closing import end_process

    run.keeper.close()
    if watch.hurries():
        end_process(run.store, last_words(go_on), EXIT_CODE, run.time_s())
    error = ray_died(go_on, death)
    end_process(run.store, f"error: {error}", error.exit_code, run.time_s())
