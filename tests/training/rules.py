"""`training.rules` of tests."""

# Networks of a hundred anchors would be small, and all that tests look at of other sizes.
SIZES_AS_SET = "all but width_16, width_8, no_context, one_bit_less"


def without(rules: str, *names: str) -> str:
    """The same `training.rules`, "all but ..." some, without these either."""
    return ", ".join((rules, *names))
