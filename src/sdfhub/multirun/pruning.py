"""Optuna's pruning for a training of a search: a Lightning callback."""

import optuna
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch import Callback, LightningModule, Trainer

from sdfhub.errors import SdfhubError


class Pruning(Callback):
    """Ends a training early where earlier trials of its search were better; it is judged as it then stands.

    Args:
        monitor: what is compared after each validation, lower is better.
        pruner: of Optuna; by default the median of earlier trials at the same step decides.
    """

    def __init__(self, monitor: str = "val/cd", pruner: optuna.pruners.BasePruner | None = None) -> None:
        self.monitor = monitor
        self.pruner = pruner or optuna.pruners.MedianPruner()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.sanity_checking:
            return
        if self.monitor not in trainer.callback_metrics:
            raise SdfhubError(f"callbacks.pruning.monitor={self.monitor}: no validation logs it")
        hydra = HydraConfig.get()  # the sweeper hands no trial on: the words of the cell tell which one it is
        study = optuna.load_study(hydra.sweeper.study_name, hydra.sweeper.storage, pruner=self.pruner)
        words = set(hydra.overrides.task)
        running = [trial for trial in study.trials if not trial.state.is_finished()]
        ours = [trial for trial in running if {f"{k}={v}" for k, v in trial.params.items()} <= words]
        trial = optuna.trial.Trial(study, ours[-1]._trial_id)
        trial.report(float(trainer.callback_metrics[self.monitor]), trainer.global_step)
        trainer.should_stop = trainer.should_stop or trial.should_prune()
