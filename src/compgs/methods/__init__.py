"""What can be trained, written and opened again: `compgs`, plain 3DGS, and the methods they are compared with.

    import compgs

    model = compgs.train(scene, method="3dgs", preset="quick")
    compgs.methods.write(model, "garden.ply", method="3dgs")

On the command line it is `compgs train --method NAME`. Run folders, checkpoints, resuming and the evaluation of the
file on disk are the same for all methods; a run's config.json, checkpoint and results.json say which method made it.

## How to add a method

A method is a file or a folder of this package, and a line of `registry`. One that compresses plain 3DGS trains by
`compgs.training.train_phases` with hooks of its own (`compgs.training.Hooks`: what is drawn, what is added to the loss,
what happens after a step), and keeps its file in the shared container (`compgs.formats.packed`), which is opened by its
first bytes wherever a scene is. `compgs.methods.parts` has what several methods are made of. Modules here are loaded
with the command line's help: what needs torch is imported where it is used. This is a whole method, which trains splats
with three bits of color and stores them so:

    @dataclass(frozen=True)
    class CoarseSection:
        # levels of a color channel
        levels: Annotated[int, Range(2, 256)] = 8

    @dataclass(frozen=True)
    class CoarseConfig(Config):
        coarse: CoarseSection = field(default_factory=CoarseSection)

    def train(scene, config, run, start=None):
        from compgs.methods.coarse.hooks import CoarseColors  # class CoarseColors(Hooks): def transform(...)
        from compgs.training import Phase, fine_tuning, train_phases

        levels = config.coarse.levels
        tuned = Phase(fine_tuning(config, config.training.steps // 2), lambda: CoarseColors(levels))
        return train_phases(scene, (Phase(config), tuned), run, start).model()

    def write(model, path, config):
        arrays = model.splats
        ...
        return write_packed(path, Packed("coarse", {"levels": config.coarse.levels}, {"colors": indices, ...}))

    def opened(packed, device, background):  # in compgs/published/coarse.py, named in READERS there
        colors = packed.array("colors", np.uint8, (None, 3)) / (packed.whole_number("levels", 2, 256) - 1)
        ...
        return splat_model(packed, SplatArrays(...), device, background)

    METHOD = Method("coarse", "Plain 3DGS with few colors", "nobody, 2026", PACKED_SUFFIX,
                    (*SPLAT_SETTINGS, "coarse"), train, write, CoarseConfig, from_splats=True)

Its settings are then `--set coarse.levels=16`, and its tests: a file's bytes by the method's byte law, the round trip,
a run that was stopped and continued (`tests/methods`).
"""

from compgs.methods.method import PACKED_SUFFIX, SPLAT_SETTINGS, Method
from compgs.methods.registry import METHODS
from compgs.methods.running import settings_of, train, write

__all__ = ["METHODS", "PACKED_SUFFIX", "SPLAT_SETTINGS", "Method", "settings_of", "train", "write"]
