"""Write what the manual takes from the code: the text between `<!-- NAME -->` and `<!-- end -->`.

python docs/generate.py
"""

import ast
import re
from collections.abc import Callable, Iterator
from pathlib import Path

from ldo_service.actors.topology import mermaid_diagram, topics_table

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "README.md", ROOT / "docs/architecture.md")
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


BLOCKS: dict[str, Callable[[], str]] = {
    "ldo topics --markdown": topics_table,
    "ldo topics --mermaid": lambda: f"```mermaid\n{mermaid_diagram()}\n```",
    "packages": packages_table,
}


def generated(page: str) -> str:
    """The page with every block as the code has it now. Raises KeyError for an unknown block."""
    return BLOCK.sub(lambda found: f"{found[1]}{BLOCKS[found['name']]()}\n{found[3]}", page)


if __name__ == "__main__":
    for path in PAGES:
        path.write_text(generated(path.read_text()))
