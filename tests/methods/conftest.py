"""A method that nobody would publish: masks learned with the splats, then few colors for all of them.

And what the methods' tests share: that a run may stop anywhere, files with something changed, quality.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest
import torch
from torch import nn

import compgs
from compgs import methods, metrics, render
from compgs.config import Config, Range
from compgs.errors import SplatFileError
from compgs.formats import SplatArrays
from compgs.formats.packed import SUFFIX, Packed, packed_bits, read, splat_model, unpacked_bits, write_packed
from compgs.methods import METHODS, SPLAT_SETTINGS, Method
from compgs.model.splats import SplatModel
from compgs.opening import open_scene
from compgs.published import READERS
from compgs.render.render_model import Renderable
from compgs.scene.views import Scene
from compgs.tensors.splats import Splats
from compgs.training import Hooks, Phase, fine_tuning, train_phases

BITS = 3


@dataclass(frozen=True)
class ToySection:
    # of the steps that follow plain training
    tuned: Annotated[float, Range(0, 1, above=True)] = 0.5
    # weight of the masks
    weight: Annotated[float, Range(0, 10)] = 0.01


@dataclass(frozen=True)
class ToyConfig(Config):
    toy: ToySection = field(default_factory=ToySection)


class Masks(Hooks):
    """How much of each splat is drawn."""

    per_splat = ("mask",)

    def __init__(self, weight: float) -> None:
        super().__init__()
        self.rates = {"mask": (0.05, 0.01)}
        self.weight = weight

    def begin(self, trainer: Any) -> None:
        self.mask = nn.Parameter(torch.full((len(trainer.parameters),), 2.0))

    def transform(self, splats: Splats, trainer: Any) -> Splats:
        return replace(splats, opacity_logits=splats.opacity_logits - torch.exp(-self.mask))

    def loss(self, drawn: Any, trainer: Any) -> torch.Tensor:
        return self.weight * self.mask.sigmoid().mean()

    def finish(self, trainer: Any) -> None:
        if self.mask.isfinite().all():  # the second time there is nothing to add
            trainer.parameters.opacity_logits.data -= torch.exp(-self.mask.detach())
            self.mask.data.fill_(torch.inf)


class FewColors(Hooks):
    """Colors of a palette, which is trained."""

    per_splat = ("labels",)

    def __init__(self) -> None:
        super().__init__()
        self.rates = {"palette": (1e-3, 1e-3)}

    def begin(self, trainer: Any) -> None:
        dc = trainer.parameters.dc.detach()
        self.palette = nn.Parameter(dc[torch.linspace(0, len(dc) - 1, 1 << BITS).long()].clone())
        self.register_buffer("labels", torch.cdist(dc, self.palette.detach()).argmin(1))

    def transform(self, splats: Splats, trainer: Any) -> Splats:
        return replace(splats, dc=self.palette[self.labels])


def train(scene: Any, config: ToyConfig, run: Any, start: SplatModel | None = None) -> tuple[Any, Any]:
    config = replace(config, splats=replace(config.splats, harmonics=0))
    tuned = fine_tuning(config, max(1, round(config.toy.tuned * config.training.steps)))
    masked = Phase(config, lambda: Hooks() if start else Masks(config.toy.weight))
    trainer = train_phases(scene, (masked, Phase(tuned, FewColors)), run, start)
    return trainer.model(), trainer.hooks


def write(trained: tuple[Any, Any], path: Path, config: ToyConfig) -> int:
    model, colors = trained
    arrays = model.splats
    stored = {
        name: getattr(arrays, name) for name in ("means", "log_scales", "quaternions", "opacity_logits")
    }
    labels = packed_bits(colors.labels.cpu().numpy(), BITS)
    palette = colors.palette.detach().cpu().numpy()
    facts = {"offset": list(model.world_offset)}
    return write_packed(path, Packed("toy", facts, {**stored, "labels": labels, "palette": palette}))


def open_file(packed: Packed, device: Any, background: Any) -> SplatModel:
    means = packed.array("means", np.float32, (None, 3))
    count = len(means)
    labels = packed.array("labels", np.uint8, (-(-count * BITS // 8),))
    palette = packed.array("palette", np.float32, (1 << BITS, 3))
    arrays = SplatArrays(
        means,
        packed.array("log_scales", np.float32, (count, 3)),
        packed.array("quaternions", np.float32, (count, 4)),
        packed.array("opacity_logits", np.float32, (count,)),
        palette[unpacked_bits(labels, BITS, count)],
        np.zeros((count, 0, 3), np.float32),
    )
    return splat_model(packed, arrays, device, background)


TOY = Method(
    name="toy",
    description="few colors",
    reference="these tests",
    suffix=SUFFIX,
    uses=(*SPLAT_SETTINGS, "toy"),
    train=train,
    write=write,
    settings=ToyConfig,
    presets={"heavy": {"toy": {"weight": 1.0}}},
    from_splats=True,
)


@pytest.fixture(autouse=True)
def toy(monkeypatch: pytest.MonkeyPatch) -> Method:
    """That method, registered."""
    monkeypatch.setitem(METHODS, "toy", TOY)
    monkeypatch.setitem(READERS, "toy", open_file)
    return TOY


@pytest.fixture
def check_continues(blob_scene: Any, tmp_path: Path) -> Any:
    """A check that runs of a method, stopped after some steps and continued, end with the same file."""

    def check(method: str, config: Any, stops: tuple[int, ...], splats: SplatModel | None = None) -> None:
        def trained(name: str, stop: int | None = None, resume: bool = False) -> bytes:
            def look(status: Any) -> None:
                if status.step == stop:
                    raise KeyboardInterrupt

            options = {"output": tmp_path / name, "resume": resume, "progress": look, "splats": splats}
            model = methods.train(blob_scene, config, method=method, device="cpu", **options)
            path = tmp_path / f"{name}.packed"
            methods.write(model, path, method=method, config=config)
            return path.read_bytes()

        whole = trained("whole")
        assert whole == trained("whole", resume=True), "a finished run gives the same again"
        for stop in stops:
            with pytest.raises(KeyboardInterrupt):
                trained(f"stopped{stop}", stop)
            assert trained(f"stopped{stop}", resume=True) == whole, stop

    return check


@pytest.fixture
def changed(tmp_path: Path) -> Callable[..., Path]:
    """`changed(file, facts, arrays)`: a copy of a file with some facts and arrays replaced."""

    def write(file: Path, facts: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Path:
        found, path = read(file), tmp_path / "changed.packed"
        write_packed(path, Packed(found.method, {**found.facts, **facts}, {**found.arrays, **arrays}))
        return path

    return write


@pytest.fixture
def check_refused(changed: Callable[..., Path]) -> Callable[..., None]:
    """`check_refused(file, facts, arrays, message)`: a check that the file so changed does not open, and why."""

    def check(file: Path, facts: Mapping[str, Any], arrays: Mapping[str, np.ndarray], message: str) -> None:
        with pytest.raises(SplatFileError, match=message):
            open_scene(changed(file, facts, arrays))

    return check


@pytest.fixture(scope="session")
def quality() -> Callable[[Renderable, Scene], float]:
    """dB over the training views: what is coded is what they taught."""

    def of(model: Renderable, scene: Scene) -> float:
        images = [metrics.to_8bit(render(model, view.camera).image) for view in scene.train_views]
        pairs = zip(images, scene.train_views, strict=True)
        return float(np.mean([metrics.psnr(image, view.image) for image, view in pairs]))

    return of


@pytest.fixture
def check_not_converted(tmp_path: Path) -> Callable[[Path], None]:
    """A check that a file whose splats networks make anew for each camera is neither exported nor compressed."""

    def check(file: Path) -> None:
        for convert, name in ((compgs.export, "b.ply"), (compgs.compress, "b.cgs")):
            with pytest.raises(
                SplatFileError, match=re.escape(f"{file.name}: its splats are made anew for each camera")
            ):
                convert(file, tmp_path / name)
        assert not list(tmp_path.iterdir())

    return check
