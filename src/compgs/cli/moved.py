"""Options that were another command's once: they are understood, and the present words are said."""

from collections.abc import Sequence

from compgs.cli.console import say

# Of `compgs train`, and what `compgs tiles` calls them.
OF_TILES = {"--tiles": "--grid", "--tile": "--tile"}


def in_words_of_today(words: Sequence[str]) -> list[str]:
    """A command line whose `compgs train --tiles`, or `--tile`, is `compgs tiles`."""
    names = [word.partition("=")[0] for word in words]
    if words[0] != "train" or not any(name in OF_TILES for name in names):
        return list(words)
    say("compgs train --tiles has become a command of its own: compgs tiles SCENE -o RUN --grid NxM")
    today = [OF_TILES.get(name, name) + word[len(name) :] for name, word in zip(names, words, strict=True)]
    return ["tiles", *today[1:]]
