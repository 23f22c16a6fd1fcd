"""Generator of the parts of the documentation pages that come from the code.

`python docs/generate.py` replaces the text between `<!-- NAME -->` and `<!-- end -->` in each page
and draws `docs/actors.svg`. With `--check` it changes nothing, and exits with code 1 if a page or
the drawing is out of date.
"""

import ast
import dataclasses
import inspect
import re
import sys
import tokenize
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from types import NoneType, UnionType
from typing import Any

import tyro

from ldo_service.actors.topology import GRAPH, mermaid_diagram, topics_table
from ldo_service.commands import cli
from ldo_service.config import Config
from ldo_service.config.printing import section_titles, settings_of
from ldo_service.schemas.topics import TOPICS

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = tuple(
    DOCS / name for name in ("architecture.md", "configuration.md", "topics.md", "command-line.md")
)
UNITS = {"_s": "s", "_m": "m", "_rad": "rad", "_px": "px", "_mb": "MB", "_gb": "GB"}
UNITS |= {"_frames": "frames", "_keyframes": "keyframes", "_ratio": "fraction"}
BLOCK = re.compile(r"(<!-- (?P<name>[^>]+) -->\n).*?(<!-- end -->)", re.DOTALL)
TAG = re.compile(r"(?P<code>`[^`]*`)|<(?P<name>\w+)>")
COMMAND = re.compile(r"^(?:\s+\S|ldo )")


def packages_table() -> str:
    """Return a Markdown table of all packages with the first sentence of each docstring."""
    lines = ["| package | contents |", "|---|---|"]
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
    """Return Markdown with one table of public settings per section of the configuration."""
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
    """Return a sentence that counts the public and advanced settings, and the paper's constants."""
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


def messages() -> str:
    """Return Markdown with a table of fields for each message and each record in a message."""
    topics: dict[str, list[str]] = {}
    for topic in TOPICS:
        for message in filter(None, (topic.message, topic.answer)):
            topics.setdefault(message.__name__, []).append(topic.name)
    structs = {
        node.name: (node, path)
        for path in sorted((ROOT / "schemas").glob("*.py"))
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef) and _is_struct(node)
    }
    records = [name for name in structs if name not in topics and name != "Message"]
    lines = [*_fields_of("Message", *structs["Message"], [])]
    for name in sorted(topics):
        lines += _fields_of(name, *structs[name], topics[name])
    for name in sorted(records):
        lines += _fields_of(name, *structs[name], [])
    return "\n".join(lines[:-1])


def types() -> str:
    """Return a Markdown table of the type aliases in `schemas`, such as `Box`.

    Fields of messages use these types. Record types (structs) are not in the table.
    """
    rows = dict[str, str]()
    for path in sorted((ROOT / "schemas").glob("*.py")):
        comments = _comments(path)
        for node in ast.parse(path.read_text()).body:
            if not (isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript)):
                continue
            name = ast.unparse(node.targets[0])
            if re.fullmatch(r"[A-Z]\w*[a-z]\w*", name):
                meaning = _comment_of(node, comments)
                rows.setdefault(name, f"| `{name}` | {_values(node.value)} | {meaning} |")
    head = ["| type | values | meaning |", "|---|---|---|"]
    return "\n".join([*head, *(rows[name] for name in sorted(rows))])


def _values(kind: ast.Subscript) -> str:
    if ast.unparse(kind.value) == "Literal" and isinstance(kind.slice, ast.Tuple):
        return ", ".join(f'`"{ast.literal_eval(value)}"`' for value in kind.slice.elts)
    return f"`{ast.unparse(kind)}`"


def _is_struct(node: ast.ClassDef) -> bool:
    return any(ast.unparse(base) in ("msgspec.Struct", "Message") for base in node.bases)


def _fields_of(name: str, node: ast.ClassDef, path: Path, topics: list[str]) -> list[str]:
    comments = _comments(path)
    lines = [f"### {name}", ""]
    if topics:
        lines += ["Topic: " + ", ".join(f"`{topic}`" for topic in topics) + ".", ""]
    for paragraph in (ast.get_docstring(node) or "").split("\n\n"):
        rows = paragraph.splitlines()
        is_aligned = len(rows) > 1 and all(re.search(r"\S  +\S", row) for row in rows)
        lines += ["```text", *rows, "```"] if is_aligned else [" ".join(paragraph.split())]
        lines.append("")
    fields = [part for part in node.body if isinstance(part, ast.AnnAssign)]
    if fields:
        lines += ["| field | type | default | meaning |", "|---|---|---|---|"]
    for field in fields:
        kind = ast.unparse(field.annotation).replace(" | ", " or ")
        default = f"`{ast.unparse(field.value)}`" if field.value else ""
        meaning = _comment_of(field, comments).replace("|", "\\|")
        lines.append(f"| `{ast.unparse(field.target)}` | `{kind}` | {default} | {meaning} |")
    return [*lines, ""] if fields else lines


def _comments(path: Path) -> dict[int, tuple[str, bool]]:
    """Return each comment of a file by its line, with True if the line has no code."""
    with path.open("rb") as file:
        return {
            token.start[0]: (token.string.lstrip("# "), token.line.strip().startswith("#"))
            for token in tokenize.tokenize(file.readline)
            if token.type == tokenize.COMMENT
        }


def _comment_of(field: ast.AnnAssign | ast.Assign, comments: dict[int, tuple[str, bool]]) -> str:
    above, line = list[str](), field.lineno - 1
    while line in comments and comments[line][1]:
        above.insert(0, comments[line][0])
        line -= 1
    lines = range(field.lineno, (field.end_lineno or field.lineno) + 1)
    return " ".join([*above, *(comments[line][0] for line in lines if line in comments)])


def commands() -> str:
    """Return Markdown with the help and a table of arguments for each subcommand of `ldo`."""
    lines = list[str]()
    for name, verb in cli.verbs().items():
        lines += [f"## ldo {name}", "", *_help(verb), *_arguments(verb)]
        for sub, kind in _subcommands(verb):
            lines += [f"### ldo {name} {sub}", "", *_help(kind), *_arguments(kind)]
    return "\n".join(lines[:-1])


def _help(verb: Callable[..., Any]) -> Iterator[str]:
    for paragraph in (inspect.getdoc(verb) or "").split("\n\n"):
        words, code = list[str](), list[str]()
        for line in paragraph.splitlines():
            (code if COMMAND.match(line) else words).append(line.strip())
        if words:
            yield from (" ".join(words), "")
        if code:
            yield from ("```sh", *code, "```", "")


def _arguments(verb: Callable[..., Any]) -> list[str]:
    rows = list(_rows(verb))
    if not rows:
        return []
    lines = ["| argument | meaning | default |", "|---|---|---|"]
    return [*lines, *(f"| {name} | {text} | {default} |" for name, text, default in rows), ""]


def _rows(verb: Callable[..., Any]) -> Iterator[tuple[str, str, str]]:
    """Yield a row for each argument; for a dataclass, a row for each of its fields instead."""
    owner = verb.__init__ if inspect.isclass(verb) else verb
    hints = typing.get_type_hints(owner, include_extras=True)
    for name, parameter in inspect.signature(verb).parameters.items():
        kind, marks = _annotation(hints[name])
        if dataclasses.is_dataclass(kind):
            yield from _rows(typing.cast(type, kind))
        elif not _parts(kind):
            yield _row(name, parameter.default, marks, kind)


def _row(name: str, default: object, marks: list[Any], kind: object) -> tuple[str, str, str]:
    argument = next((mark for mark in marks if hasattr(mark, "metavar")), None)
    metavar = (argument and argument.metavar) or ""
    choices = typing.get_args(kind) if typing.get_origin(kind) is typing.Literal else ()
    metavar = metavar or "\\|".join(map(str, choices))
    meaning = ((argument and argument.help) or "").replace("|", "\\|")
    if tyro.conf.Positional in marks:
        shown = f"`{metavar or name.upper()}`"
    else:
        given = (argument and argument.name) or name
        options = [
            f"--{given.strip('_').replace('_', '-')}",
            *((argument and argument.aliases) or ()),
        ]
        shown = ", ".join(f"`{option} {metavar}`".replace(" `", "`") for option in options)
    is_plain = default in (inspect.Parameter.empty, None, (), "", False)
    return (
        shown.replace("|", "\\|").replace("\\\\|", "\\|"),
        meaning,
        "" if is_plain else f"`{default}`",
    )


def _subcommands(verb: Callable[..., Any]) -> Iterator[tuple[str, Callable[..., Any]]]:
    for hint in typing.get_type_hints(verb, include_extras=True).values():
        for part in _parts(_annotation(hint)[0]):
            kind, marks = _annotation(part)
            yield next(mark.name for mark in marks if hasattr(mark, "name")), kind


def _annotation(hint: Any) -> tuple[Any, list[Any]]:
    """Return the type without its annotations and without None, and the list of annotations."""
    marks = list[Any]()
    while typing.get_origin(hint) is typing.Annotated:
        hint, *more = typing.get_args(hint)
        marks += more
    if typing.get_origin(hint) in (typing.Union, UnionType):
        kinds = [kind for kind in typing.get_args(hint) if kind is not NoneType]
        if len(kinds) == 1:
            hint = kinds[0]
    return hint, marks


def _parts(kind: Any) -> tuple[Any, ...]:
    """Return the members of a union of subcommands."""
    parts = typing.get_args(kind) if typing.get_origin(kind) in (typing.Union, UnionType) else ()
    return tuple(part for part in parts if dataclasses.is_dataclass(_annotation(part)[0]))


# Place of each actor in the drawing: column and row.
PLACES = {
    "camera": (0, 0), "odometry": (0, 2), "frame_source": (1, 0), "tracker": (1, 2),
    "detector": (2, 0), "loop_closer": (2, 4), "mapper": (3, 2), "vlm_labeller": (4, 0),
    "optimizer": (4, 4),
}  # fmt: skip
WIDTH_PX, HEIGHT_PX, COLUMN_PX, ROW_PX = 120, 34, 170, 62


def drawing() -> str:
    """Return an SVG drawing of the actors and their connections.

    A solid arrow stands for at least one topic with the policy Lossless or Backlog. A dashed arrow
    stands for topics with the policy Latest.
    """
    arrows = dict[tuple[str, str], bool]()
    for line in mermaid_diagram().splitlines():
        if found := re.match(r"\s+(\w+) (-->|-\.->)\|[^|]+\| (\w+)", line):
            maker, arrow, taker = found.groups()
            arrows[maker, taker] = arrows.get((maker, taker), False) or arrow == "-->"
    lines = [_arrow(maker, taker, solid) for (maker, taker), solid in arrows.items()]
    outside = {"camera": "camera", "odometry": "other odometry"}
    lines += [_box(name, text, "#ffffff") for name, text in outside.items()]
    lines += [_box(actor.name, actor.name, "#e3ecf7") for actor in GRAPH]
    size = f'width="{4 * COLUMN_PX + WIDTH_PX + 20}" height="{4 * ROW_PX + HEIGHT_PX + 20}"'
    marker = (
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" '
        'markerHeight="7" orient="auto"><path d="M0 0 8 4 0 8z" fill="#335"/></marker></defs>'
    )
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif" font-size="14">'
    )
    back = '<rect width="100%" height="100%" fill="#ffffff"/>'
    return "\n".join([head, back, marker, *lines, "</svg>\n"])


def _center(name: str) -> tuple[float, float]:
    column, row = PLACES[name]
    return 10 + column * COLUMN_PX + WIDTH_PX / 2, 10 + row * ROW_PX + HEIGHT_PX / 2


def _box(name: str, text: str, fill: str) -> str:
    x, y = _center(name)
    place = f'x="{x - WIDTH_PX / 2:g}" y="{y - HEIGHT_PX / 2:g}"'
    size = f'width="{WIDTH_PX}" height="{HEIGHT_PX}" rx="6"'
    words = f'<text x="{x:g}" y="{y + 5:g}" text-anchor="middle" fill="#223">{text}</text>'
    return f'<rect {place} {size} fill="{fill}" stroke="#335"/>{words}'


def _arrow(maker: str, taker: str, solid: bool) -> str:
    """Return an arrow between two boxes.

    It is shifted to its right, so that arrows in opposite directions do not overlap.
    """
    (x0, y0), (x1, y1) = _center(maker), _center(taker)
    length = ((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5
    right_x, right_y = -(y1 - y0) / length * 7, (x1 - x0) / length * 7
    x0, y0, x1, y1 = x0 + right_x, y0 + right_y, x1 + right_x, y1 + right_y
    sx, sy = _leave(maker, x0, y0, x1, y1)
    ex, ey = _leave(taker, x1, y1, x0, y0)
    dash = "" if solid else ' stroke-dasharray="5 4"'
    ends = f'x1="{sx:.1f}" y1="{sy:.1f}" x2="{ex:.1f}" y2="{ey:.1f}"'
    return f'<line {ends} stroke="#335" stroke-width="1.4"{dash} marker-end="url(#tip)"/>'


def _leave(name: str, x0: float, y0: float, x1: float, y1: float) -> tuple[float, float]:
    """Return the point where a line that starts inside a box leaves the box."""
    x, y = _center(name)
    steps = [1.0]
    if x1 != x0:
        side = x + (WIDTH_PX / 2 if x1 > x0 else -WIDTH_PX / 2)
        steps.append((side - x0) / (x1 - x0))
    if y1 != y0:
        side = y + (HEIGHT_PX / 2 if y1 > y0 else -HEIGHT_PX / 2)
        steps.append((side - y0) / (y1 - y0))
    step = min(steps)
    return x0 + step * (x1 - x0), y0 + step * (y1 - y0)


BLOCKS: dict[str, Callable[[], str]] = {
    "ldo topics --markdown": topics_table,
    "packages": packages_table,
    "public settings": public_settings,
    "number of settings": settings_count,
    "messages": messages,
    "types": types,
    "commands": commands,
}


def generated(page: str) -> str:
    """Return the page with the text of each block replaced by the output of its `BLOCKS` function.

    Raises:
        KeyError: The page has an unknown block.
    """
    return BLOCK.sub(
        lambda found: f"{found[1]}{_escaped(BLOCKS[found['name']]())}\n{found[3]}", page
    )


def _escaped(text: str) -> str:
    """Return Markdown in which a name in angle brackets is text and not an HTML tag."""
    return TAG.sub(lambda found: found["code"] or f"&lt;{found['name']}&gt;", text)


def outputs() -> Iterator[tuple[Path, str]]:
    """Yield the path of each generated file and its up-to-date text."""
    yield from ((page, generated(page.read_text())) for page in PAGES)
    yield DOCS / "actors.svg", drawing()


def main() -> None:
    stale = [path for path, text in outputs() if not path.exists() or path.read_text() != text]
    if "--check" in sys.argv[1:]:
        names = ", ".join(str(path.relative_to(ROOT)) for path in stale)
        sys.exit(f"{names}: out of date. Run python docs/generate.py" if stale else 0)
    for path, text in outputs():
        path.write_text(text)


if __name__ == "__main__":
    main()
