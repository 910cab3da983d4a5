"""Hook of MkDocs: the site has the paths of the repository, so that a link between documents works in both."""

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

PAGES = ("docs/**/*.md", "docs/**/*.ipynb", "*.md", "problems/*/*.md", "studies/*/*.md")
BESIDE = (
    "docs/*.js",
    "docs/*.css",
    "studies/*/*.png",
    "docs/pictures/*.png",
    "studies/*.py",
    "problems/*/*.*",
    "casacal/**/*.py",
    "tests/**/*.py",
    "LICENSE",
    "CITATION.cff",
)
"""Pages, and what else they link to."""


@event_priority(100)  # before the plug-in that makes pages of notebooks
def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """All pages and what they link to, under their paths in the repository; the README is the front page."""
    root = Path(config.config_file_path).parent
    found = {path: None for pattern in PAGES + BESIDE for path in sorted(root.glob(pattern)) if path.is_file()}
    where = (str(root), config.site_dir, config.use_directory_urls)
    made = [File(path.relative_to(root).as_posix(), *where) for path in found]
    api = [File.generated(config, f"docs/api/{name}.md", content=text) for name, text in api_pages(root)]
    theme = [file for file in files if not Path(file.abs_src_path or "/").is_relative_to(config.docs_dir)]
    return Files(theme + made + api)


def api_pages(root: Path) -> Iterator[tuple[str, str]]:
    """A page for each section of the public names: name of the page, and its text for mkdocstrings."""
    names = (root / "docs" / "public.md").read_text(encoding="utf-8").split("## Modules")[0]
    for section in re.split(r"\n###? ", names)[1:]:
        title, _, table = section.partition("\n")
        home = title.strip("`") if title.startswith("`casacal.") else "casacal"
        if entries := [f"::: {home}.{name}\n" for name in re.findall(r"^\| `(\w+)` \|", table, re.M)]:
            page = title.strip("`").removeprefix("casacal.").lower().replace(",", "").replace(" ", "_")
            yield page, f"# {title}\n\n" + "\n".join(entries)


def on_page_content(html: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links of notebooks to documents, which MkDocs itself follows only where the page is Markdown."""
    del config

    def followed(link: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(posixpath.dirname(page.file.src_uri), link[1]))
        if (file := files.get_file_from_path(path)) is None:
            raise PluginError(f"{page.file.src_uri} links to {link[1]}, which does not exist")
        return f'href="{file.url_relative_to(page.file)}"'

    return re.sub(r'href="([\w./]+\.(?:md|ipynb))"', followed, html) if page.file.src_uri.endswith(".ipynb") else html
