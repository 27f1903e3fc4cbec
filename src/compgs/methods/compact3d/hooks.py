"""Training with codes in place of values, and with a penalty on opacities."""

from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from compgs.config import TrainingConfig
from compgs.formats.packed import Packed
from compgs.methods.compact3d.settings import Compact3DSection
from compgs.methods.parts.books import entries_within
from compgs.methods.parts.fake_quantization import straight_through
from compgs.methods.parts.vector_quantization import code_means, first_codes, k_means
from compgs.model.degrees import degree_of
from compgs.published.compact3d import (
    LABELED,
    SORTED,
    codebook_bytes,
    packed_splats,
    splat_bytes,
)
from compgs.tensors.splats import Splats
from compgs.training.splats.hooks import Drawn, Hooks

if TYPE_CHECKING:
    from compgs.training.splats.hooks import SplatRun

CODED = (*LABELED, SORTED)
LEAST_EVERY = 20  # steps between two assignments in short runs: in fewer, values hardly move to other codes
SEED = 11  # of the first codes, beside the run's


class LearnedCodebooks(Hooks):
    """Buffers, of each of CODED: `*_labels` [M] int64, and `*_codes` [K, C], of no rows before codes are in use.

    What is drawn are the means of the values that have the same label, as they are at each step; a splat's gradient
    goes to its own values (straight through), and so moves the mean, or the splat to another code.
    """

    per_splat = tuple(f"{name}_labels" for name in CODED)
    penalized: Tensor  # [] int64: splats when the penalty began. Later, fewer of them do not leave more of it to each

    def __init__(self, section: Compact3DSection, training: TrainingConfig) -> None:
        super().__init__()
        self.section = section
        self.seed = training.seed
        steps = training.steps
        self.start, self.stop = round(section.start * steps), round(section.stop * steps)
        self.every = max(round(section.every * steps), LEAST_EVERY)
        self.penalty = range(*(round(share * steps) for share in section.opacity_steps))
        self.prune_every = max(1, round(section.prune_every * steps))

    def begin(self, trainer: "SplatRun") -> None:
        splats = trainer.parameters.trained()
        for name in CODED:
            values = getattr(splats, name).flatten(1)
            self.register_buffer(f"{name}_labels", torch.zeros(len(values), dtype=torch.int64))
            self.register_buffer(f"{name}_codes", values.new_zeros(0, values.shape[1]))
        self.register_buffer("penalized", torch.zeros((), dtype=torch.int64))
        self.to(trainer.device)
        self.after_step(trainer)

    def transform(self, splats: Splats, trainer: "SplatRun") -> Splats:
        drawn = {}
        for name, codes in self.codes(splats).items():
            values = getattr(splats, name)
            drawn[name] = straight_through(values, codes[self.labels(name)].view_as(values))
        return replace(splats, **drawn)

    def loss(self, drawn: Drawn, trainer: "SplatRun") -> Tensor | None:
        if trainer.step not in self.penalty or not self.section.opacity_weight:
            return None
        total = drawn.splats.opacity_logits.sigmoid().sum()
        return self.section.opacity_weight / max(1, int(self.penalized)) * total

    def after_step(self, trainer: "SplatRun") -> None:
        step = trainer.step
        if step == self.penalty.start:
            self.penalized.fill_(len(trainer.parameters))
        judged = (step - self.penalty.start) % self.prune_every == 0 or step == self.penalty.stop
        if judged and step - 1 in self.penalty and self.section.opacity_weight:
            self.prune(trainer)
        if step == self.start or (self.start < step < self.stop and (step - self.start) % self.every == 0):
            self.assign(trainer)

    @torch.no_grad()
    def prune(self, trainer: "SplatRun") -> None:
        """Remove what is transparent."""
        kept = trainer.parameters.opacity_logits.sigmoid() >= trainer.config.splats.prune_opacity
        if kept.any() and not kept.all():
            trainer.keep(kept)

    @torch.no_grad()
    def assign(self, trainer: "SplatRun") -> None:
        """Labels anew; the first time, codes too."""
        splats = trainer.parameters.trained()
        rounds = self.section.rounds
        codes = self.codes(splats)
        if not codes:
            rounds = self.section.first_rounds
            chance = torch.Generator().manual_seed(self.seed + SEED)
            for name, count in self.counts(len(splats), splats.degree).items():
                codes[name] = first_codes(getattr(splats, name).flatten(1), count, chance)
        for name, begun in codes.items():
            moved, labels = k_means(getattr(splats, name).flatten(1), begun, rounds)
            setattr(self, f"{name}_codes", moved)
            setattr(self, f"{name}_labels", labels)

    def counts(self, splats: int, degree: int) -> dict[str, int]:
        """Codes of each codebook, for so many splats."""
        s = self.section

        def harmonics(codes: int) -> int:
            return -(-codes * s.harmonics_codebook // s.codebook)

        per_splat = splat_bytes(s.codebook, s.harmonics_codebook, degree, bit_quantized=s.bit_quantized)
        codes = entries_within(
            s.codebook,
            per_splat * splats,
            lambda k: codebook_bytes(k, harmonics(k), degree),
            s.codebook_share,
        )
        counts = dict.fromkeys(("dc", "log_scales", SORTED), min(codes, splats))
        return {**counts, "rest": min(harmonics(codes), splats)} if degree else counts

    def labels(self, name: str) -> Tensor:
        labels: Tensor = getattr(self, f"{name}_labels")
        return labels

    def codes(self, splats: Splats) -> dict[str, Tensor]:
        """[K, C] by name, as the splats are now; none before codes are in use."""
        known = {name: getattr(self, f"{name}_codes") for name in CODED}
        return {
            name: code_means(getattr(splats, name).detach().flatten(1), self.labels(name), codes)
            for name, codes in known.items()
            if codes.numel()
        }

    def estimated_bytes(self, trainer: "SplatRun") -> int:
        count, degree = len(trainer.parameters), degree_of(trainer.parameters.rest.shape[1])
        codes = self.counts(count, degree)
        k, rest = codes[SORTED], codes.get("rest", 1)
        per_splat = splat_bytes(k, rest, degree, bit_quantized=self.section.bit_quantized)
        return round(count * per_splat) + codebook_bytes(k, rest, degree)

    def content(self, trainer: "SplatRun") -> Packed:
        """Return the content of the file, after the last step."""
        splats = trainer.parameters.trained()
        codes = self.codes(splats)
        if not codes:  # a run of a step or so
            self.assign(trainer)
            codes = self.codes(splats)
        return packed_splats(
            splats.arrays(trainer.world_offset),
            {name: self.labels(name).cpu().numpy() for name in codes},
            {name: value.cpu().numpy() for name, value in codes.items()},
            bit_quantized=self.section.bit_quantized,
        )
