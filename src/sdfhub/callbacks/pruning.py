"""Trainings of an Optuna search that are not promising end early."""

from typing import Any

import lightning as L

from sdfhub.errors import SdfhubError


class OptunaPruning(L.Callback):
    """Reports a metric to a search's study at each validation; stops the training if the pruner says so.

    What the training has learnt by then is judged as ever, and its score is the trial's value. Hydra's
    sweeper hands no trial on: it is the newest running one with the training's `overrides`, `key=value`.
    `storage` is the URL of the `study`'s database, `pruner` is Optuna's; the metric `monitor` is minimised.
    """

    def __init__(
        self, storage: Any, study: str | None, overrides: list[str], pruner: Any, monitor: str = "val/cd"
    ):  # without a search Hydra knows neither of the first two
        self.storage, self.study, self.overrides = storage, study, set(overrides)
        self.pruner, self.monitor = pruner, monitor

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if trainer.sanity_checking:
            return
        import optuna  # an extra, and slow to import

        if self.monitor not in trainer.callback_metrics:
            raise SdfhubError(f"callbacks.pruning.monitor={self.monitor}: no validation logs it")
        try:
            study = optuna.load_study(study_name=self.study, storage=self.storage, pruner=self.pruner)
        except KeyError as error:
            raise SdfhubError(f"callbacks.pruning: no study {self.study!r} in {self.storage}") from error
        running = study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.RUNNING,))
        ours = [t for t in running if {f"{k}={v}" for k, v in t.params.items()} <= self.overrides]
        if not ours:
            raise SdfhubError("callbacks.pruning: no running trial has this training's settings")
        trial = optuna.trial.Trial(study, ours[-1]._trial_id)
        trial.report(float(trainer.callback_metrics[self.monitor]), trainer.global_step)
        trainer.should_stop = trainer.should_stop or trial.should_prune()
