"""Bytes become integers: the mirror image of writer.py, section by section. Nothing is taken on trust."""

from dataclasses import dataclass

import numpy as np

from compgs.codec.content import (
    Dimensions,
    FileContent,
    Latents,
    channel_index,
    fixed_point,
    reconstruct,
    residual_context,
    scatter_existing,
)
from compgs.codec.format import (
    COVARIANCE,
    FREE_SYMBOLS,
    HEADS,
    HYPER_TABLES,
    MASKS,
    MAX_SYMBOL,
    METADATA,
    NETWORKS,
    PADDING,
    POSITIONS,
    POSITIONS_GPCC,
    REFERENCE,
    REFERENCE_HYPER,
    RESIDUAL,
    RESIDUAL_HYPER,
    SCENE,
    SECTION_NAMES,
    SYMBOLS_PER_BYTE,
    VERSION,
    container_bytes,
    unpack,
)
from compgs.codec.integer_network import entropy_parameters
from compgs.codec.mask_coder import decode_masks
from compgs.codec.octree import decode_positions
from compgs.codec.rans import decode_symbols
from compgs.codec.sections import SceneSection, decode_hyper_tables, decode_metadata, decode_scene
from compgs.codec.tables import FrequencyTables, channel_tables, gaussian_tables
from compgs.codec.tmc3 import decode_positions_tmc3
from compgs.codec.weights import decode_heads, decode_networks
from compgs.errors import CorruptSection


@dataclass(frozen=True)
class SectionInfo:
    """What a section costs."""

    name: str
    bytes: int
    bits_per_anchor: float
    bits_per_coupled: float  # per coupled primitive that exists


@dataclass(frozen=True)
class FileInfo:
    """What can be said about a file without decoding it. The sections' bytes, "container" included, sum to
    `bytes`.
    """

    version: int
    bytes: int
    anchors: int
    coupled: int  # coupled primitives that exist
    dimensions: Dimensions
    scene: SceneSection
    sections: tuple[SectionInfo, ...]
    metadata: dict[str, str]

    @property
    def bits_per_anchor(self) -> float:
        return 8.0 * self.bytes / self.anchors


def read_content(data: bytes) -> FileContent:
    """The content of a .cgs file, anchors in canonical order.

    Raises NotACompGSFile, UnsupportedVersion, TruncatedSection or CorruptSection; the message names the
    section.
    """
    return read_latents(data)[0]


def read_latents(data: bytes, *, keep_symbols: bool = True) -> tuple[FileContent, Latents]:
    """The content, and its latents, which the entropy decoder needs anyway (`dequantize` would compute them
    again). Not `keep_symbols`: each stream's symbols go, and are empty in the content, as soon as they have
    served; with all of them the peak of memory would be above three times the size of the model.
    """
    sections = {section.number: section.data for section in unpack(data)}
    scene = decode_scene(sections[SCENE], SECTION_NAMES[SCENE])
    d = scene.dimensions
    _check_amount(scene, len(data))
    if any(sections.get(PADDING, b"")):
        raise CorruptSection(f"{SECTION_NAMES[PADDING]}: expected zero bytes")
    metadata = decode_metadata(sections[METADATA], SECTION_NAMES[METADATA]) if METADATA in sections else {}
    hyper_tables = decode_hyper_tables(
        sections[HYPER_TABLES], SECTION_NAMES[HYPER_TABLES], d.reference_hyper_dim + d.residual_hyper_dim
    )
    reference_hyper_tables = hyper_tables[: d.reference_hyper_dim]
    residual_hyper_tables = hyper_tables[d.reference_hyper_dim :]
    networks = decode_networks(sections[NETWORKS], SECTION_NAMES[NETWORKS], d.network_sizes())
    heads = decode_heads(sections[HEADS], SECTION_NAMES[HEADS])
    if POSITIONS in sections:
        coordinates = decode_positions(sections[POSITIONS], scene.anchors)
    else:
        coordinates = decode_positions_tmc3(sections[POSITIONS_GPCC], scene.anchors)
    mask = decode_masks(sections[MASKS], scene.anchors, d.coupled_primitives)
    coupled = int(mask.sum())
    if coupled != scene.coupled:
        raise CorruptSection(
            f"masks: {coupled} coupled primitives exist, the scene section promises {scene.coupled}"
        )

    gaussian = gaussian_tables()

    def stream(number: int, index: np.ndarray, tables: FrequencyTables) -> np.ndarray:
        symbols = decode_symbols(sections[number], index.ravel(), tables, SECTION_NAMES[number])
        if len(symbols) and (symbols.min() < -MAX_SYMBOL or symbols.max() > MAX_SYMBOL):
            raise CorruptSection(f"{SECTION_NAMES[number]}: a symbol is not in -{MAX_SYMBOL} to {MAX_SYMBOL}")
        return symbols.reshape(index.shape)

    def kept(symbols: np.ndarray) -> np.ndarray:
        return symbols if keep_symbols else np.empty((0, 0), np.int32)

    index = channel_index(scene.anchors, d.reference_hyper_dim)
    reference_hyper = stream(REFERENCE_HYPER, index, channel_tables(reference_hyper_tables))
    means, index = entropy_parameters(networks["reference"], fixed_point(reference_hyper))
    reference = stream(REFERENCE, index, gaussian)
    reference_latents = reconstruct(reference, means)
    reference_hyper, reference = kept(reference_hyper), kept(reference)
    del means, index

    means, index = entropy_parameters(networks["covariance"], reference_latents)
    covariance = stream(COVARIANCE, index, gaussian)
    covariance_latents = reconstruct(covariance, means)
    covariance = kept(covariance)
    del means, index

    index = channel_index(scene.anchors, d.residual_hyper_dim)
    residual_hyper = stream(RESIDUAL_HYPER, index, channel_tables(residual_hyper_tables))
    context = residual_context(residual_hyper, reference_latents)
    residual_hyper = kept(residual_hyper)
    means, index = entropy_parameters(networks["residual"], context, mask)
    symbols = stream(RESIDUAL, index, gaussian)
    del context, index  # the peak of memory comes next
    residual_latents = reconstruct(symbols, means)
    del means
    residual = scatter_existing(symbols, mask) if keep_symbols else kept(symbols)

    content = FileContent(
        dimensions=d,
        voxel_size=scene.voxel_size,
        view_distance_scale=scene.view_distance_scale,
        background=scene.background,
        reference_step=scene.reference_step,
        residual_step=scene.residual_step,
        covariance_step=scene.covariance_step,
        coordinates=coordinates,
        mask=mask,
        reference_hyper=reference_hyper,
        reference=reference,
        covariance=covariance,
        residual_hyper=residual_hyper,
        residual=residual,
        reference_hyper_tables=reference_hyper_tables,
        residual_hyper_tables=residual_hyper_tables,
        networks=networks,
        heads=heads,
        metadata=metadata,
    )
    return content, Latents(reference_latents, covariance_latents, residual_latents)


def file_info(data: bytes) -> FileInfo:
    """Bytes and bits by section; verifies the checksums and decodes the scene section alone."""
    sections = unpack(data)
    by_number = {section.number: section.data for section in sections}
    scene = decode_scene(by_number[SCENE], SECTION_NAMES[SCENE])
    _check_amount(scene, len(data))
    metadata = decode_metadata(by_number[METADATA], SECTION_NAMES[METADATA]) if METADATA in by_number else {}
    sizes = [(section.name, len(section.data)) for section in sections]
    sizes.append(("container", container_bytes(len(sections))))
    return FileInfo(
        version=VERSION,
        bytes=len(data),
        anchors=scene.anchors,
        coupled=scene.coupled,
        dimensions=scene.dimensions,
        scene=scene,
        sections=tuple(
            SectionInfo(name, size, 8.0 * size / scene.anchors, 8.0 * size / max(scene.coupled, 1))
            for name, size in sizes
        ),
        metadata=metadata,
    )


def _check_amount(scene: SceneSection, size: int) -> None:
    """Symbols against the file's size, before anything is allocated."""
    symbols = scene.anchors * scene.dimensions.symbols_per_anchor()
    allowed = FREE_SYMBOLS + SYMBOLS_PER_BYTE * size
    if symbols > allowed:
        raise CorruptSection(
            f"{SECTION_NAMES[SCENE]}: {scene.anchors} anchors promise {symbols} symbols, "
            f"a file of {size} bytes holds at most {allowed}"
        )
