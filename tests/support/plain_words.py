"""Words and patterns that are errors in pages, messages and help.

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

#: In docstrings these.
NOT_IN_DOCSTRINGS = re.compile(
    "|".join(
        (
            r"\b[Tt]old\b|\b[Ss]aid\b|\b[Bb]eside\b|\b[Aa]new\b|\b[Ll]est\b|\b[Ww]hoever\b",
            r"\b[Bb]lind(ly)?\b|\b(put down|planned again)\b|\b[Dd]ead zone\b",
            r"(?<!there )\b(is|are) none\b",
            r"(^|(?<=[.:;] ))What (?![^.?!]*\?)",  # name the noun
            r"^(Return|Give|Write) what\b",
            r"\bso many\b(?! that)|\bgone on with\b",  # this many, continued
        )
    )
)

#: Words that are not in a name: a noun says what it holds.
NOT_IN_NAMES = {
    "anew", "beside", "blind", "doubt", "drawn", "found", "said", "share", "shares", "told", "verb",
    "way", "ways",
}  # fmt: skip
#: Names that have one all the same: an idiom, the protocol's own words, drawings.
NAMES = {
    "_under_way", "drawn", "Drawn", "FILE_NOT_FOUND", "MODULE_NOT_FOUND", "MOST_DRAWN", "NOT_FOUND",
    "share", "fractions_of", "under_way", "_not_found",
}  # fmt: skip
