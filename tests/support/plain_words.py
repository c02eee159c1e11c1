"""Words and patterns that do not come back in pages, messages and help.

docs/glossary.md has the terms to use instead.
"""

import re

NOT_AGAIN = re.compile(
    "|".join(
        (
            r"\b[Tt]old\b",  # commanded
            r"\b[Ss]aid\b",  # predicted, given
            r"\b[Bb]eside\b",  # next to, in addition to
            r"\b[Aa]new\b",  # again
            r"\b[Bb]lind(ly)?\b",  # open-loop
            r"\b[Dd]rawn outcomes?\b",  # random samples
            r"\b(is|are) (put down|planned again|refused|none)\b",
            r"\b[Dd]ead zone\b",  # dead band
            r"\b[Ll]est\b|\b[Ww]hoever\b",
            r"(?<=[.:;] )What (?![^.?!]*\?)",  # name the noun
        )
    )
)
#: In messages and help also these; pages are checked for the length of their sentences.
NOT_IN_MESSAGES = re.compile(
    "|".join(
        (
            NOT_AGAIN.pattern,
            r"(?<!there )\b(is|are) no (?!longer)",  # is not a, has no
            r"\b(put down|planned again|that sees)\b",  # placed, replanned, closed-loop
            r"\bgo(es)? on\b",  # continue
            r"\b[Ss]hare\b",  # fraction
            r"\b[Vv]erb\b",  # command
            r"\bso (many|long)\b",
            r"(^|[.:;,(] )[Ww]hat (?![^.?!]*\?)",
            r"\b(of|for|by|with|from|to|than) what\b",
        )
    )
)

#: Names of variables and arguments that a noun replaces.
NOT_NAMES = {"blind", "dead_zone", "doubt", "found", "verb"}
