"""Training of COSA-GS: plain anchors that grow, then bits of the whole scene in the loss, and masks in the bits."""

import torch
from torch import Tensor

from compgs.entropy.quantization import UniformNoise
from compgs.errors import TrainingError
from compgs.methods.anchors.prediction import AnchorValues
from compgs.methods.anchors.trainer import AnchorTrainer
from compgs.methods.cosa.entropy import Chained
from compgs.methods.cosa.model import CosaModel
from compgs.methods.cosa.settings import CosaConfig
from compgs.scene.views import Scene
from compgs.tensors.prediction import Prediction

BITS_PER_MEGABYTE = 8e6  # lambda weighs megabytes of the file


class CosaTrainer(AnchorTrainer):
    """Adds the rate to the training of anchors."""

    kind_of_model = CosaModel
    model: CosaModel
    config: CosaConfig

    def __init__(
        self,
        scene: Scene,
        config: CosaConfig,
        device: torch.device,
        method: str,
        model: CosaModel | None = None,
    ) -> None:
        super().__init__(scene, config, device, method, model)
        self.noise = UniformNoise(config.training.seed + 3, self.views.chance, device)
        self.rate_at = round(config.cosa.rate_start * config.training.steps)
        self.chained: Chained | None = None  # of the present step
        self.masks: Tensor | None = None  # [N, K] of the present step

    def groups(self) -> dict[str, tuple[list[Tensor], tuple[float, float]]]:
        m, c = self.model, self.config.cosa
        return {
            **super().groups(),
            "latents": ([m.latents], c.latent_lr),
            "masks": ([m.mask_logits], c.mask_lr),
            "steps": (list(m.chain.log_steps.parameters()), c.step_lr),
            "entropy": (list(m.chain.statistics()), self.config.training.entropy_lr),
        }

    @property
    def lmbda(self) -> float | None:
        return self.config.training.lmbda

    def values(self) -> AnchorValues:
        """Return the values; from the second phase on with noise, which stands for rounding, and masks."""
        if self.step < self.rate_at:
            return self.model.values()
        if not self.model.begun:
            self.model.begin()
        rounded = self.progress >= self.config.cosa.symbols_start
        self.chained = self.model.chained(None if rounded else self.noise)
        self.masks = self.model.masks()
        return self.model.seen(self.chained, self.masks)

    def added(self) -> Tensor | None:
        """lambda x megabytes of the whole scene."""
        if self.chained is None or self.masks is None:
            return None
        bits = self.model.total_bits(self.chained.bits, self.masks)
        self.chained, self.masks = None, None
        return self.config.training.lmbda / BITS_PER_MEGABYTE * bits

    def vanishing(self, prediction: Prediction) -> Tensor | float:
        """Masks may leave few primitives."""
        return 0.0 if self.model.begun else super().vanishing(prediction)

    def weights(self) -> dict[str, Tensor]:
        if self.progress >= self.config.training.borders.weights:
            return self.model.stored_weights()
        return super().weights()

    def finish_step(self) -> None:
        """Remove, in the second phase, anchors that have no primitive left, as often as growth came in the first."""
        super().finish_step()
        if self.model.begun and (self.step - self.rate_at) % self.schedule.every == 0:
            self.drop_empty()

    def drop_empty(self) -> None:
        """Remove anchors whose primitives are all masked."""
        kept = self.model.kept().any(1)
        if kept.any() and not kept.all():
            self.control.keep(self.model, self.optimizer, kept)

    def estimated_bytes(self) -> int:
        return self.model.estimated_bytes() if self.model.begun else super().estimated_bytes()

    def finish(self) -> None:
        """What is masked is not in the file."""
        if not self.model.begun:
            self.model.begin()
        self.drop_empty()
        self.model.mask = self.model.kept()
        if not self.model.mask.any():
            raise TrainingError("all primitives are masked; the run has failed: use a smaller lambda")
