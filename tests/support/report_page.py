"""A parser of report pages for the tests."""

import re
from html.parser import HTMLParser

VOID = {"meta", "br", "link", "img", "hr", "input"}


class Page(HTMLParser):
    """Text, attributes and tables of a page; fails where an element is not closed in order."""

    def __init__(self, path):
        super().__init__()
        self.open, self.ids, self.references, self.words = [], [], [], []
        self.tables, self.svgs, self.captions = [], [], []
        self.tags = set()
        self.feed(path.read_text(encoding="utf-8"))
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        attributes = dict(attributes)
        self.ids += [attributes["id"]] if "id" in attributes else []
        self.references += [attributes[key] for key in ("href", "src", "xlink:href")
                            if key in attributes]  # fmt: skip
        self.references += re.findall(
            r"url\(([^)]*)\)", " ".join(filter(None, attributes.values()))
        )
        if tag == "svg":
            self.svgs.append(attributes)
        if tag == "table":
            self.tables.append([])
        if tag == "tr":
            self.tables[-1].append([])
        if tag in ("td", "th"):
            self.tables[-1][-1].append("")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)
        if self.open and self.open[-1] in ("td", "th"):
            self.tables[-1][-1][-1] += data

    @property
    def text(self):
        return re.sub(r"\s+", " ", " ".join(self.words))

    def table(self, first_head):
        """Return the rows of the table whose head begins with these words."""
        (result,) = [rows for rows in self.tables
                    if any(row[: len(first_head)] == first_head for row in rows[:2])]  # fmt: skip
        return result
