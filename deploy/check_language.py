"""Check of the language of docstrings, comments and errors.

    python deploy/check_language.py [FILE...]

Without arguments, the program reads every tracked Python and C++ file. It prints a line for each
violation, and exits with status 1 if there is a violation. Violations are:

- a docstring or a comment that opens with a fragment, such as "Whether ..." or "Of the ...";
- a word that the glossary retires, such as "twin" for a reference implementation;
- an error that prints `{self}` instead of the setting and its value.
"""

import ast
import io
import re
import subprocess
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parent.parent
# Words that open a fragment instead of a sentence or a noun phrase.
OPENER = re.compile(
    r"(what|whose|who|whom|whoever|where|whether|how|of|all|those|which|that|with|without|as|for|"
    r"from|nothing|nobody|none|somebody|likewise|else|so|not|also|therefore|hence|per|than|its|"
    r"their|to|in|on|at|over|under|among|against|beside|between|before|after|until|unless|while|"
    r"once|up|no|never|there|these|why|above|below|beyond|behind|within|through|only|when|like)\b",
    re.IGNORECASE,
)
# Words that docs/glossary.md replaces. Words that are parts of identifiers do not match.
RETIRED = re.compile(
    r"(?<![\w-])(nobody|somebody|whoever|anew|asleep|awake|torn|mend(?:s|ed|ing)?|outvoted|"
    r"vouch(?:es|ed)?|for ever|last words|first words|hangs? on|predecessors?|successors?|told|"
    r"twins?|colour(?:s|ed)?|centre[sd]?|grey|neighbour(?:s|ing)?|optimis(?:e[sdr]?|ing|ation)|"
    r"recognis(?:e[sd]?|ing|able)|(?:re)?localis(?:e[sd]?|ing|ation)|metres?|licence|catalogues?|"
    r"labeled|rasteris(?:e[sdr]?|ing|ation)|normalis(?:e[sd]?|ing|ation))(?![\w])",
    re.IGNORECASE,
)
DIRECTIVE = re.compile(r"#\s*(noqa|type:|pyright|fmt:|!|-{3,}|={3,})")
CPP_COMMENT = re.compile(r"//[^\n]*(?:\n[ \t]*//[^\n]*)*|/\*.*?\*/", re.DOTALL)
CODE = re.compile(r"`[^`]*`")
Finding = tuple[int, str]


def main(arguments: list[str]) -> int:
    """Check the files and return the exit status."""
    files = [Path(name).resolve() for name in arguments] or list(_tracked_files())
    count = 0
    for path in files:
        check = _check_python if path.suffix in (".py", ".pyi") else _check_cpp
        for line, message in sorted(check(path.read_text(encoding="utf-8"))):
            shown = path.relative_to(ROOT) if path.is_relative_to(ROOT) else path
            print(f"{shown}:{line}: {message}")
            count += 1
    if count:
        print(f"{count} violations. CONTRIBUTING.md says how we write.")
    return int(count > 0)


def _tracked_files() -> Iterator[Path]:
    command = ["git", "ls-files", "*.py", "*.pyi", "*.cpp", "*.hpp"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    paths = (ROOT / name for name in listed.split())
    yield from (path for path in paths if path != Path(__file__).resolve())


def _check_python(source: str) -> Iterator[Finding]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            text = ast.get_docstring(node)
            if text:
                yield from _check_text(node.body[0].lineno, "docstring", text)
        elif isinstance(node, ast.Raise) and _prints_self(node):
            yield node.lineno, "error prints {self}: name the setting and its value"
    for line, text in _python_comments(source):
        yield from _check_text(line, "comment", text)


def _prints_self(node: ast.Raise) -> bool:
    return any(
        isinstance(part, ast.FormattedValue)
        and isinstance(part.value, ast.Name)
        and part.value.id == "self"
        for part in ast.walk(node)
    )


def _python_comments(source: str) -> Iterator[Finding]:
    """Yield line number and text of each comment.

    Comment lines that follow each other at the same column are joined to one comment.
    """
    first_line = last_line = 0
    last_column, text = -1, ""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type != tokenize.COMMENT or DIRECTIVE.match(token.string):
            continue
        (line, column), words = token.start, token.string.lstrip("# ")
        if line == last_line + 1 and column == last_column:
            text += " " + words
        else:
            if text:
                yield first_line, text
            first_line, text = line, words
        last_line, last_column = line, column
    if text:
        yield first_line, text


def _check_cpp(source: str) -> Iterator[Finding]:
    for found in CPP_COMMENT.finditer(source):
        text = re.sub(r"\n\s*//", " ", found[0]).lstrip("/* ")
        if not re.match(r"-{3,}|={3,}", text):
            yield from _check_text(source[: found.start()].count("\n") + 1, "comment", text)


def _check_text(line: int, kind: str, text: str) -> Iterator[Finding]:
    prose = CODE.sub("", text)
    if opener := OPENER.match(text):
        yield line, f"{kind} opens with {opener[0]!r}: {text[:60]!r}"
    for word in RETIRED.finditer(prose):
        yield line, f"{kind} has the retired word {word[0]!r}"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
