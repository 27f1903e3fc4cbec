"""LightGaussian (Fan et al., NeurIPS 2024): the splats that matter least go, harmonics are distilled to fewer, and the
colors of most splats share a codebook.

    plain 3DGS ──► prune two of three ──► settle ──► degree 3 teaches degree 2 ──► codebook for most ──► DEFLATE
    the run                               1/6 more   1/6 more

`docs/methods/lightgaussian.md` says what is as published, and the law of bytes.
"""

from typing import TYPE_CHECKING

from compgs.methods.lightgaussian.settings import NAME, LightGaussianConfig
from compgs.methods.method import PACKED_SUFFIX, SPLAT_SETTINGS, Method, write_itself

if TYPE_CHECKING:
    from compgs.model.splats import SplatModel
    from compgs.published.parts.content import Content
    from compgs.scene.views import Scene
    from compgs.training.run.run import Run


def train(
    scene: "Scene", config: LightGaussianConfig, run: "Run", start: "SplatModel | None" = None
) -> "Content":
    """The content of the file. Raises as `compgs.train` does."""
    from compgs.methods.lightgaussian.hooks import Distilled, Pruned, content
    from compgs.published.lightgaussian import opened
    from compgs.published.parts.content import Content
    from compgs.training.splats.phases import Phase, fine_tuning, train_phases

    section, steps = config.lightgaussian, config.training.steps
    settled, distilled = (
        fine_tuning(config, max(1, round(share * steps))) for share in (section.settled, section.distilled)
    )
    phases = (
        Phase(config),
        Phase(settled, lambda: Pruned(section)),
        Phase(distilled, lambda: Distilled(section, config.training.seed)),
    )
    trainer = train_phases(scene, phases, run, start)
    return Content(content(trainer, config), scene.background, opened, ("raw", "deflate"), run.device)


LIGHTGAUSSIAN = Method(
    name=NAME,
    description="plain 3DGS, pruned by significance, harmonics distilled, a codebook of colors",
    reference="Fan et al., LightGaussian, NeurIPS 2024",
    suffix=PACKED_SUFFIX,
    uses=(*SPLAT_SETTINGS, NAME),
    train=train,
    write=write_itself,
    settings=LightGaussianConfig,
    presets={"scaled": {NAME: {"codebook_share": 0.1}}},
    from_splats=True,
)
