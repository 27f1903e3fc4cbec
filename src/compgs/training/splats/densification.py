"""Adaptive density control of plain 3DGS (Kerbl et al. 2023, Sec. 5.2): clone, split, prune, reset opacities.

Where the loss has a large gradient by a splat's 2D mean, small splats are cloned and large ones split in two;
transparent splats are removed, and after the first reset of the opacities also those that are too large for the scene.
(The published program also removes what is large in the image; gsplat by default does not, and neither do we.)

The published schedule counts steps of a run of 30 000. As mere fractions of a short run, it would judge splats that no
view has shown since, or that have had no time to part from their clones, and reset opacities faster than they recover.
So there are floors: a pass over the views between two judgements, and as many steps as published or a tenth of the
time there is; between two resets five passes and 300 steps, and no reset without the time to recover before
densification ends. Floors end at the published numbers of steps: a run of 30 000 steps goes as published.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from compgs.cameras import Camera
from compgs.config import SplatConfig
from compgs.tensors.splats import Splats

SPLIT_INTO = 2
LOG_SHRINK = torch.log(torch.tensor(0.8 * SPLIT_INTO)).item()  # how much smaller a part is


@dataclass(frozen=True)
class DensifySchedule:
    """Steps of a run at which density control acts, and those at which opacities are reset."""

    start: int
    stop: int
    every: int
    reset_every: int

    def active(self, step: int) -> bool:
        """Gradients are gathered in this step."""
        return step < self.stop

    def due(self, step: int) -> bool:
        return self.start <= step < self.stop and (step - self.start) % self.every == 0

    def reset_due(self, step: int) -> bool:
        """Whether opacities are reset after this step; never too late for them to recover before densification ends."""
        last = self.stop - self.reset_every // 2
        return 0 < step <= last and step % self.reset_every == 0


def densify_schedule(config: SplatConfig, steps: int, views: int, views_per_step: int = 1) -> DensifySchedule:
    """Fractions of the run in steps; see the module's docstring for the floors."""
    stop = round(config.densify_stop * steps)
    views = math.ceil(views / views_per_step)  # steps of a pass
    few = min(max(views, stop // 10), 100)
    # At the published rate, a logit needs a hundred steps to climb from an opacity of 0.01 to 0.5.
    recovery = min(max(5 * views, 300), 3_000)
    return DensifySchedule(
        start=max(1, round(config.densify_start * steps), min(views, 500)),
        stop=stop,
        every=max(1, round(config.densify_every * steps), few),
        reset_every=max(1, round(config.reset_every * steps), recovery),
    )


class DensityControl:
    """Gradients of the splats since density was last controlled, and what follows from them."""

    def __init__(
        self,
        config: SplatConfig,
        extent: float,  # of the scene, world units
        splats: int,
        device: torch.device,
    ) -> None:
        self.config = config
        self.extent = extent
        self.gradient = torch.zeros(splats, device=device)  # sum of 2D gradient norms, in half images
        self.seen = torch.zeros(splats, device=device)  # views in which the splat was drawn

    STATISTICS = ("gradient", "seen")

    @torch.no_grad()
    def observe(self, mean_gradient: Tensor, visible: Tensor, camera: Camera) -> None:
        """One training view: gradient of the loss by the 2D means [M, 2], which splats were drawn [M] bool."""
        across, down = mean_gradient.unbind(1)
        in_half_images = torch.stack([across * (camera.width / 2), down * (camera.height / 2)], 1)
        self.gradient += in_half_images.norm(dim=1)  # (zero where it was not drawn)
        self.seen += visible

    def forget(self, splats: int) -> None:
        """Statistics of so many splats start anew."""
        self.gradient = self.gradient.new_zeros(splats)
        self.seen = self.seen.new_zeros(splats)

    def keep(self, kept: Tensor) -> None:
        """Only the splats of `kept` [M] bool are left."""
        self.gradient, self.seen = self.gradient[kept], self.seen[kept]

    @torch.no_grad()
    def chosen(
        self,
        splats: Splats,
        drawn: Splats,  # the same splats as they are drawn, by which they are judged
        chance: torch.Generator,
        *,
        remove_large: bool,
    ) -> tuple[Tensor, Splats, Tensor]:
        """Clone, split and prune: which splats stay, [M] bool; the new ones; the rows that these came from, [A] int64.

        If nothing would be left, nothing is removed.
        """
        c = self.config
        asks = self._densified(self.gradient / self.seen.clamp_min(1))
        sizes = drawn.log_scales.amax(1)
        large = sizes.exp() > c.split_size * self.extent
        cloned, divided = (torch.nonzero(asks & some).view(-1) for some in (~large, large))
        parts = split(splats.rows(divided), chance, drawn.rows(divided))
        clones = splats.rows(cloned)
        added = Splats(**{name: torch.cat([t, getattr(parts, name)]) for name, t in vars(clones).items()})
        origins = torch.cat([cloned, divided.repeat(SPLIT_INTO)])
        new_sizes = sizes[origins]
        new_sizes[len(cloned) :] -= LOG_SHRINK
        opacities = drawn.opacity_logits.sigmoid()
        kept = ~(asks & large) & ~self._superfluous(opacities, sizes, remove_large)
        rows = torch.nonzero(~self._superfluous(opacities[origins], new_sizes, remove_large)).view(-1)
        if not kept.any() and not len(rows):
            kept = torch.ones_like(kept)
        return kept, added.rows(rows), origins[rows]

    def _densified(self, gradient: Tensor) -> Tensor:
        """[M] bool: splats with a gradient [M] above the threshold; the strongest, if all would be too many."""
        asks = gradient >= self.config.gradient_threshold
        room = max(0, self.config.max_splats - len(gradient))  # each clone and each split adds one
        if int(asks.sum()) > room:
            strongest = torch.sort(torch.where(asks, gradient, -1.0), descending=True, stable=True).indices
            asks = torch.zeros_like(asks)
            asks[strongest[:room]] = True
        return asks

    def _superfluous(self, opacities: Tensor, sizes: Tensor, remove_large: bool) -> Tensor:
        """[M] bool: too transparent, or (if asked) too large; `sizes` [M] are logs of the largest scale."""
        removed = opacities < self.config.prune_opacity
        if remove_large:
            removed |= sizes.exp() > self.config.prune_size * self.extent
        return removed


def split(splats: Splats, chance: torch.Generator, drawn: Splats | None = None) -> Splats:
    """Smaller splats in place of each, at random places within it: SPLIT_INTO blocks of M, one after the other.

    `drawn`: the splats as they are drawn, where that is not as they are: where the places are.
    """
    rows = torch.arange(len(splats), device=splats.means.device).repeat(SPLIT_INTO)
    parts, shapes = splats.rows(rows), (drawn or splats).rows(rows)
    within = torch.randn(parts.means.shape, generator=chance, device=parts.means.device)
    offset = rotate(shapes.quaternions, within * shapes.log_scales.exp())
    return replace(parts, means=parts.means + offset, log_scales=parts.log_scales - LOG_SHRINK)


def rotate(quaternions: Tensor, vectors: Tensor) -> Tensor:  # [M, 4] w-x-y-z, [M, 3] -> [M, 3]
    """Vectors turned by (unnormalized) quaternions."""
    unit = torch.nn.functional.normalize(quaternions, dim=1)
    w, axis = unit[:, :1], unit[:, 1:]
    across = torch.linalg.cross(axis, vectors)
    return vectors + 2 * (w * across + torch.linalg.cross(axis, across))
