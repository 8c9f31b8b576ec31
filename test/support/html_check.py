"""What is wrong with a page: unbalanced tags, links to nothing, pictures without words."""

from html.parser import HTMLParser
from pathlib import Path

VOID = {"meta", "img", "br", "link", "wbr"}


class Walk(HTMLParser):
    def __init__(self):
        super().__init__(convert_charrefs=True)
        self.open, self.links, self.ids, self.faults, self.text = [], [], [], [], []

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        if len(attributes) != len(attrs):
            self.faults.append(f"<{tag}> repeats an attribute")
        self.links += [attributes[name] for name in ("href", "src") if name in attributes]
        self.ids += [attributes["id"]] if "id" in attributes else []
        if tag == "img" and not attributes.get("alt"):
            self.faults.append(f"picture {attributes.get('src')} has no alt text")
        if tag == "script":
            self.faults.append("the page runs a script")
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.faults.append(f"</{tag}> at line {self.getpos()[0]} closes nothing")

    def handle_data(self, data):
        self.text.append(data)


def faults(page: Path) -> list[str]:
    walk = Walk()
    walk.feed(page.read_text())
    walk.close()
    found = walk.faults + [f"<{tag}> stays open" for tag in walk.open]
    found += [f"id {name!r} twice" for name in set(walk.ids) if walk.ids.count(name) > 1]
    for link in walk.links:
        if link.startswith("#"):
            found += [] if link[1:] in walk.ids else [f"no anchor {link}"]
        elif link.startswith("data:image/png;base64,"):
            continue
        elif "/" in link or not (page.parent / link).is_file():
            found.append(f"no file {link}")
    return found


def text(page: Path) -> str:
    walk = Walk()
    walk.feed(page.read_text())
    return " ".join(" ".join(walk.text).split())
