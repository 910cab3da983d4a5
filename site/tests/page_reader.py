"""A page as a test reads it: elements, tables and texts, by Python's own parser; and what a valid page must be."""

from html.parser import HTMLParser

VOID = {"meta"}
REFERENCES = {"src", "href", "srcset", "action", "data", "poster", "background", "xlink:href"}


class Page(HTMLParser):
    """elements: (name, attributes, text inside) in order of their end; faults: what is not well formed."""

    def __init__(self, text):
        super().__init__(convert_charrefs=True)
        self.elements, self.faults, self._open = [], [], []
        self.feed(text)
        self.close()
        self.faults += [f"{name} is not closed" for name, *_ in self._open]
        ids = [attributes["id"] for _, attributes, _ in self.elements if "id" in attributes]
        self.faults += [f"id {name} twice" for name in set(ids) if ids.count(name) > 1]
        for name, attributes, _ in self.elements:
            for wanted in ("aria-labelledby", "aria-describedby"):
                self.faults += [f"no id {each}" for each in attributes.get(wanted, "").split() if each not in ids]
            if name == "svg" and not attributes.get("aria-labelledby"):
                self.faults.append("a picture without words")

    def handle_starttag(self, name, attributes):
        keys = [key for key, _ in attributes]
        self.faults += [f"{name} has {key} twice" for key in set(keys) if keys.count(key) > 1]
        if name in VOID:
            self.elements.append((name, dict(attributes), ""))
        else:
            self._open.append((name, dict(attributes), []))

    def handle_endtag(self, name):
        if not self._open or self._open[-1][0] != name:
            self.faults.append(f"{name} ends where {self._open[-1][0] if self._open else 'nothing'} is open")
            return
        name, attributes, words = self._open.pop()
        text = "".join(words)
        self.elements.append((name, attributes, text))
        if self._open:
            self._open[-1][2].append(text)

    def handle_data(self, data):
        if self._open:
            self._open[-1][2].append(data)

    def all(self, name):
        return [(attributes, text) for found, attributes, text in self.elements if found == name]

    def text_of(self, key):
        return next(" ".join(text.split()) for _, attributes, text in self.elements if attributes.get("id") == key)

    def by_class(self, word):
        return [
            " ".join(t.split()) for _, attributes, t in self.elements if word in attributes.get("class", "").split()
        ]


def tables(text):
    """Cells of each table, by its id: a list of rows, the heading first."""
    found = {}
    for piece in text.split("<table ")[1:]:
        whole = Page("<table " + piece.partition("</table>")[0] + "</table>")
        key = whole.all("table")[0][0]["id"]
        rows, row = [], []
        for name, attributes, words in whole.elements:
            if name in ("th", "td"):
                assert name == "td" or attributes["scope"] in ("row", "col")
                row.append(" ".join(words.split()))
            elif name == "tr":
                rows.append(row)
                row = []
        assert whole.all("caption")[0][1].strip()
        found[key] = rows
    return found


def facts(text, key):
    """Pairs of a list of facts."""
    part = Page(f'<dl id="{key}"' + text.split(f'<dl id="{key}"')[1].partition("</dl>")[0] + "</dl>")
    names, values = ([" ".join(t.split()) for _, t in part.all(kind)] for kind in ("dt", "dd"))
    return dict(zip(names, values, strict=True))
