"""Several processes that train one scene (torchrun): each renders other views of the same model.

Every process, a *rank*, holds the whole model and takes the same steps. What it computes of its own views, gradients
above all, is summed over the ranks; from the sums all compute the same, so that parameters stay identical without ever
being sent. `check_identical` sees to that. Rank 0 alone writes and tells.

In a world of one, a process by itself, every function here does nothing: nobody needs to ask.
"""

import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor, nn

from compgs.errors import ConfigError, TrainingError
from compgs.interrupt import held_back

_T = TypeVar("_T")


# who is there ----------------------------------------------------------------------------------


def world() -> int:
    """Number of ranks."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def rank() -> int:
    """Which of them this process is, from 0."""
    return dist.get_rank() if world() > 1 else 0


def launched_rank() -> int:
    """The rank that torchrun gave to this process, also before it has `joined`; 0 for a process by itself."""
    return int(os.environ["RANK"]) if launched() else 0


def launched() -> bool:
    """Whether torchrun, or what sets the same variables, started this process as one of several."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1 and "RANK" in os.environ


def local_device(device: torch.device) -> torch.device:
    """Return the rank's own device, on a machine with several GPUs."""
    if device.type == "cuda" and device.index is None and launched():
        return torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
    return device


@contextmanager
def joined(device: torch.device) -> Iterator[None]:
    """Inside, the processes of a torchrun know one another. One that fails leaves without a word to the others: their
    next sum fails, too, and says so. Raises ConfigError if they do not find each other.
    """
    if not launched() or world() > 1:
        yield
        return
    if device.type == "cuda":
        torch.cuda.set_device(device)
    try:
        # Flags are on the CPU: nobody need wait for a GPU to read them.
        dist.init_process_group("cpu:gloo,cuda:nccl" if device.type == "cuda" else "gloo")
    except (RuntimeError, ValueError) as error:
        raise ConfigError(
            f"rank {launched_rank()} of {os.environ['WORLD_SIZE']}: the others were not found at "
            f"{os.environ.get('MASTER_ADDR')}:{os.environ.get('MASTER_PORT')} ({_first_line(error)})"
        ) from error
    yield
    dist.destroy_process_group()


# what they share -------------------------------------------------------------------------------


def share_of_rank(things: Sequence[_T]) -> Sequence[_T]:
    """Every n-th of the things, of n ranks: those that this rank looks at."""
    return things[rank() :: world()] if world() > 1 else things


def sum_over_ranks(*tensors: Tensor) -> None:
    """Each of the tensors [...], which are changed, over all ranks. Raises TrainingError if one is gone."""
    if world() > 1:
        with _communication_errors():
            for work in [dist.all_reduce(tensor, async_op=True) for tensor in tensors]:
                work.wait()


def on_any_rank(*flags: bool) -> tuple[bool, ...]:
    """Each of the flags, true if it is so on any of the ranks. Raises TrainingError if one is gone."""
    if world() == 1:
        return flags
    counts = torch.tensor(flags, dtype=torch.int32)
    with _communication_errors():
        dist.all_reduce(counts)
    return tuple(count > 0 for count in counts.tolist())


@torch.no_grad()
def sum_gradients(parameters: Iterable[nn.Parameter], *others: Tensor) -> None:
    """Sum the gradients of the parameters over all ranks; and the `others`, small tensors of any shape, which are
    changed.

    A parameter of which no rank has a gradient stays without one, and the optimizer leaves it alone.
    """
    if world() == 1:
        return
    known = list(parameters)
    there = on_any_rank(*(p.grad is not None for p in known))
    trained = [p for p, needed in zip(known, there, strict=True) if needed]
    for p in trained:
        p.grad = torch.zeros_like(p) if p.grad is None else p.grad.contiguous()
    gradients = [p.grad for p in trained if p.grad is not None]
    # Small ones are summed together, as each sum costs a journey.
    large = [g for g in gradients if g.numel() >= 1 << 18]
    small = [*(g for g in gradients if g.numel() < 1 << 18), *others]
    bundle = torch.cat([g.reshape(-1) for g in small])
    sum_over_ranks(bundle, *large)
    for g, total in zip(small, bundle.split([g.numel() for g in small]), strict=True):
        g.copy_(total.view_as(g))


@contextmanager
def summed_over_ranks(owner: Any, names: Iterable[str]) -> Iterator[None]:
    """Inside, the statistics `names` of their owner are those of all ranks.

    Outside each rank has gathered a part, and their sum is what counts: to send them at every step would double what
    gradients send. Afterwards rank 0 has them all, and the others begin with nothing.
    """
    sum_over_ranks(*(getattr(owner, name) for name in names))
    yield
    keep_on_rank_zero(owner, names)


def keep_on_rank_zero(owner: Any, names: Iterable[str]) -> None:
    """Zero the statistics on all ranks but 0, so that summing them again counts them once."""
    if rank() > 0:
        for name in names:
            getattr(owner, name).zero_()


def check_identical(step: int, tensors: Mapping[str, Tensor]) -> None:
    """Raises TrainingError on all ranks if what they have in common is not the same to the last bit."""
    if world() == 1:
        return
    own = torch.tensor([digest(tensor) for tensor in tensors.values()], dtype=torch.int64)
    found = [torch.empty_like(own) for _ in range(world())]
    with _communication_errors():
        dist.all_gather(found, own)
    for number, digests in enumerate(found):
        for name, differs in zip(tensors, (digests != found[0]).tolist(), strict=True):
            if differs:
                raise TrainingError(
                    f"step {step}: rank {number} of {world()} holds other values of {name} than rank 0; all ranks need "
                    "the same kind of processor or GPU, and the same versions of compgs, torch and numba"
                )


@contextmanager
def stopping_together() -> Iterator[None]:
    """Ctrl-C and the request to end wait for the end of the block, and then reach all ranks, whichever they came to."""
    if world() == 1:
        yield
        return
    stop: KeyboardInterrupt | None = None
    try:
        with held_back():
            yield
    except KeyboardInterrupt as arrived:
        stop = arrived
    if on_any_rank(stop is not None)[0]:
        raise stop or KeyboardInterrupt


def digest(tensor: Tensor) -> int:
    """64 bits that stand for its content."""
    content = tensor.detach().cpu().contiguous().view(-1).view(torch.uint8).numpy().data
    return int.from_bytes(hashlib.blake2b(content, digest_size=8).digest(), "little", signed=True)


@contextmanager
def _communication_errors() -> Iterator[None]:
    """Turn an error of the communication inside into a TrainingError."""
    try:
        yield
    except RuntimeError as error:
        raise TrainingError(
            f"rank {rank()} of {world()}: another rank has ended or cannot be reached; it says why "
            f"({_first_line(error)})"
        ) from error


def _first_line(error: Exception) -> str:
    return (str(error) or type(error).__name__).splitlines()[0][:120]
