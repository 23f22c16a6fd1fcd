"""Write what the manual takes from the code: the text between `<!-- NAME -->` and `<!-- end -->`.

python docs/generate.py
"""

import ast
import re
from collections.abc import Callable, Iterator
from pathlib import Path

from ldo_service.actors.topology import mermaid_diagram, topics_table
from ldo_service.config import Config
from ldo_service.config.printing import section_titles, settings_of

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "README.md", ROOT / "docs/architecture.md", ROOT / "docs/configuration.md")
UNITS = {"_s": "s", "_m": "m", "_rad": "rad", "_px": "px", "_mb": "MB", "_gb": "GB"}
UNITS |= {"_frames": "frames", "_keyframes": "keyframes", "_ratio": "fraction"}
BLOCK = re.compile(r"(<!-- (?P<name>[^>]+) -->\n).*?(<!-- end -->)", re.DOTALL)


def packages_table() -> str:
    """Markdown: every package with the first sentence of its docstring."""
    lines = ["| package | what is in it |", "|---|---|"]
    lines += [f"| `{name}/` | {_first_sentence(path)} |" for name, path in _packages()]
    return "\n".join(lines)


def _packages() -> Iterator[tuple[str, Path]]:
    links = ("actors", "schemas")
    yield from ((name, ROOT / name / "__init__.py") for name in links)
    for path in sorted((ROOT / "ldo_service").glob("*/__init__.py")):
        if path.parent.name not in links:
            yield f"ldo_service/{path.parent.name}", path


def _first_sentence(path: Path) -> str:
    text = " ".join((ast.get_docstring(ast.parse(path.read_text())) or "").split())
    return re.split(r"(?<=\.) ", text)[0]


def public_settings() -> str:
    """Return Markdown: a table of the public settings for each section of the configuration."""
    titles, lines, section = section_titles(), list[str](), ""
    for setting in settings_of(Config()):
        if not setting.is_public:
            continue
        if (first := setting.path.split(".")[0]) != section:
            section = first
            lines += ["", f"### {section}", "", titles[section], ""]
            lines += ["| setting | default | unit | meaning |", "|---|---|---|---|"]
        name, default = setting.path, setting.text.replace("|", "\\|")
        lines.append(f"| `{name}` | `{default}` | {_unit(name)} | {setting.comment} |")
    return "\n".join(lines[1:])


def settings_count() -> str:
    """Return a sentence with the numbers of settings."""
    settings = settings_of(Config())
    public = sum(setting.is_public for setting in settings)
    paper = sum(setting.path.startswith("paper.") for setting in settings)
    return (
        f"There are {public} public settings, {len(settings) - public - paper} advanced ones, and "
        f"{paper} constants of the paper in the section `paper`."
    )


def _unit(path: str) -> str:
    endings = [ending for ending in UNITS if path.endswith(ending)]
    return UNITS[max(endings, key=len)] if endings else ""


BLOCKS: dict[str, Callable[[], str]] = {
    "ldo topics --markdown": topics_table,
    "ldo topics --mermaid": lambda: f"```mermaid\n{mermaid_diagram()}\n```",
    "packages": packages_table,
    "public settings": public_settings,
    "number of settings": settings_count,
}


def generated(page: str) -> str:
    """The page with every block as the code has it now. Raises KeyError for an unknown block."""
    return BLOCK.sub(lambda found: f"{found[1]}{BLOCKS[found['name']]()}\n{found[3]}", page)


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(generated(path.read_text()))
