"""Trainings of an Optuna search that are not promising end early."""

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

import lightning as L

from sdfhub.errors import SdfhubError

if TYPE_CHECKING:
    from optuna.pruners import BasePruner
    from optuna.trial import Trial

log = logging.getLogger(__name__)


class OptunaPruning(L.Callback):
    """Reports a metric to a search's study at each validation; stops the training if the pruner says so.

    What the training has learnt by then is judged as ever, and its score is the trial's value. Hydra's
    sweeper does not tell a training its trial: it is the newest running one with the training's parameters.

    Args:
        storage: URL of the study's database.
        study: its name there.
        overrides: of this training, `key=value`.
        pruner: decides; a study does not keep one.
        monitor: name of the metric, which is minimised.
    """

    def __init__(
        self,
        storage: str,
        study: str,
        overrides: Sequence[str],
        pruner: "BasePruner",
        monitor: str = "val/cd",
    ):
        self.storage, self.study, self.overrides = storage, study, set(overrides)
        self.pruner, self.monitor = pruner, monitor
        self.trial: Trial | None = None

    def on_fit_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        import optuna  # an extra, and slow to import

        sampler = optuna.samplers.RandomSampler()  # draws nothing: the sweeper has drawn
        try:
            study = optuna.load_study(self.study, self.storage, sampler, self.pruner)
        except KeyError as error:
            raise SdfhubError(
                f"callbacks.pruning: there is no study {self.study!r} in {self.storage}"
            ) from error
        running = study.get_trials(deepcopy=False, states=[optuna.trial.TrialState.RUNNING])
        ours = [
            trial
            for trial in running
            if {f"{name}={value}" for name, value in trial.params.items()} <= self.overrides
        ]
        if not ours:
            raise SdfhubError(
                "callbacks.pruning: no running trial has this training's settings; use -m search="
            )
        self.trial = optuna.trial.Trial(study, ours[-1]._trial_id)

    def on_validation_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        value = trainer.callback_metrics.get(self.monitor)
        if trainer.sanity_checking or self.trial is None or value is None:
            return
        self.trial.report(float(value), trainer.global_step)
        if self.trial.should_prune():
            log.info("pruned after step %d: %s %.4g", trainer.global_step, self.monitor, float(value))
            trainer.should_stop = True
