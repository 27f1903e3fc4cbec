"""The rate in the loss of every few steps (not in the paper): a step without it takes a sixth less time.

The latents change little from one step to the next, and so does what they cost. A step with the rate counts as many
times as there are steps from one to the next (docs/results/decisions.md).
"""


def times_counted(step: int, every: int) -> int:
    """How many times the rate of this step is in the loss; 0: it is not."""
    return every if step % every == 0 else 0
