"""What is due after which step of a run, besides the step itself: growth, pruning, and references that turn."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch

from compgs.config import Config
from compgs.errors import TrainingError
from compgs.trained_model import TrainedModel
from compgs.training.plan import Plan, head_bits
from compgs.training.rate.file_size import anchor_bits
from compgs.training.rate.rate_control import RateState
from compgs.training.rate.target_size import TargetSize
from compgs.training.run.distributed import summed_over_ranks
from compgs.training.run.parts import Part
from compgs.training.structure.averaging import Averaging
from compgs.training.structure.control import AdaptiveControl
from compgs.training.structure.decorrelation import ChannelRates, decorrelate, drop_silent_channels
from compgs.training.structure.importance import needed_primitives
from compgs.training.structure.pruning import anchors_worth_their_bits
from compgs.training.survey import Survey


def at_shares(shares: Iterable[float], steps: int) -> frozenset[int]:
    """Steps at these shares of a run."""
    return frozenset(round(share * steps) for share in shares)


@dataclass(frozen=True)
class Event:
    """Something to be done after some steps; steps count from 0."""

    due: Callable[[int], bool]
    act: Callable[[int, RateState], None]  # after this step, with lambda as it is


class Structure:
    """Changes the model otherwise than by a step of the optimizer."""

    def __init__(
        self,
        config: Config,
        plan: Plan,
        model: TrainedModel,
        optimizer: torch.optim.Adam,
        survey: Survey,
        control: AdaptiveControl,
        chance: torch.Generator,  # of growth
    ) -> None:
        """Raises ConfigError if a size is asked for that the networks alone exceed."""
        steps = config.training.steps
        self.config = config
        self.plan = plan
        self.model = model
        self.optimizer = optimizer
        self.survey = survey
        self.control = control
        self.chance = chance
        self.average = Averaging(model)
        self.decorrelated_at = at_shares(config.entropy.decorrelate_at, steps)
        self.pruned_at = at_shares(config.control.prune_at, steps)
        self.channel_rates = ChannelRates(model, self.decorrelated_at)
        self.target_size = TargetSize(
            model, control.schedule, self.pruned_at, survey.contributions, survey.changes, plan.bit_discount
        )
        self.events = (
            Event(control.schedule.due, self.grow),
            Event(self.pruned_at.__contains__, self.prune),
            Event(self.decorrelated_at.__contains__, self.turn_references),
        )

    def act(self, step: int, rate: RateState) -> bool:
        """Do what is due after a step. Returns whether anything was."""
        due = [event for event in self.events if event.due(step)]
        for event in due:
            event.act(step, rate)
            self.survey.bounds.forget()
            self.average.forget()
        return bool(due)

    def grow(self, step: int, rate: RateState) -> None:
        """Add anchors where the image's gradient is large, and remove those that nobody sees."""
        with summed_over_ranks(self.control, AdaptiveControl.STATISTICS):
            means = self.survey.coupled_means()
            self.control.act(self.model, self.optimizer, means, self.chance, rate.lmbda)

    def prune(self, step: int, rate: RateState) -> None:
        """Remove the anchors that are not worth their bits: what is left of the run makes up for them."""
        changes = self.survey.changes(self.plan.pruning_views)
        bits = anchor_bits(self.model)
        least, most = self.target_size.bits_to_keep(step, bits, rate.written)
        lmbda, c, discount = rate.lmbda_of_pruning, self.config.control, self.plan.bit_discount
        kept = anchors_worth_their_bits(changes, bits, lmbda, c, discount, least_bits=least, most_bits=most)
        if kept.any():
            self.control.keep(self.model, self.optimizer, kept)

    def turn_references(self, step: int, rate: RateState) -> None:
        """Turn the references into their principal axes; the last time, also drop channels that hardly say anything."""
        if not torch.isfinite(self.model.references).all():
            return  # the run has diverged, and the next step will say so
        decorrelate(self.model, self.optimizer)
        if step == max(self.decorrelated_at):
            drop_silent_channels(self.model, self.optimizer)
        self.channel_rates.follow()

    def follow(self, step: int, rate: RateState, *, stored: bool) -> RateState:
        """Take in what the last step has done, after so many `step`s: the mean, what bounds anchors, the bits of the
        heads' weights unless the networks compute with weights so rounded (`stored`). Returns lambda as it is now.
        """
        t = self.config.training
        if step / t.steps > t.borders.mean:
            self.average.after_step()
        self.survey.bounds.after_step(step)
        rate = self.target_size.follow(rate, step)
        if not stored:
            bits = head_bits(self.config, self.plan.start, rate.lmbda, self.model.anchors)
            self.model.head_bits = bits
        return rate

    def parts(self) -> tuple[Part, ...]:
        """What a run remembers of this."""
        return self.channel_rates, self.average

    def finish(self) -> None:
        """End the run: take the averaged parameters, and drop coupled primitives that training views hardly see, or not
        at all, with anchors that have none left. Raises TrainingError if none is left.
        """
        self.average.settle()
        self.survey.bounds.forget()
        everything = self.survey.contributions(most=len(self.survey.scene.train_views))
        self.model.mask = needed_primitives(everything, self.config.control.idle_share)
        if not self.model.mask.any():
            raise TrainingError("no primitive is visible in any training view; the run has failed")
