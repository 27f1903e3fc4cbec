"""How a run counts sightings, passes and steps: three ways, of which `control.variant` names one.

The release of the paper's authors counts passes over the V training views: statistics from 3 V steps on, control from
5 V, every 2 V. Scaffold-GS (Lu et al. 2023) judges an anchor that was in view in 80 of 100 steps. Ours goes by the run.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Variant:
    """Counts, and what follows from them."""

    # Passes over the training views, after which the first control comes, and between two, if these are fewer steps.
    start_passes: float | None = None
    every_passes: float | None = None
    # Passes before statistics are gathered, if the first control leaves the time.
    observe_passes: float = 0.0
    # A primitive is judged that was seen in this share of the steps between two controls, also where that is less often
    # than `control.minimum_views`. Above 1 the latter decides: it takes several controls, and statistics outlast them.
    minimum_share: float = 2.0
    # An anchor in view less often, or in a smaller share of the steps between two controls, is not removed for its
    # opacity.
    opacity_views: int = 5
    opacity_share: float = 0.1
    # After a control all statistics start anew, not only of what was judged.
    reset_all: bool = False
    # Cells of 4 and 1 voxels are tried only in a control that has grown anchors in larger ones.
    finer_needs_coarser: bool = False
    # Steps of the run for which the entropy model's learning rates are meant: a run of half the steps doubles them, so
    # that its networks get as far. 0: they are as the settings say.
    entropy_steps: int = 0


VARIANTS = {
    "default": Variant(),
    # Of 2 passes a fifth is less than 41 steps only with fewer than 103 views.
    "published": Variant(
        start_passes=5.0,
        every_passes=2.0,
        observe_passes=3.0,
        minimum_share=0.2,
        opacity_views=1,
        opacity_share=0.0,
        reset_all=True,
        finer_needs_coarser=True,
        entropy_steps=30_000,
    ),
    "scaffold-gs": Variant(opacity_views=1, opacity_share=0.8, finer_needs_coarser=True),
}
