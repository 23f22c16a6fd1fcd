"""Plain values out of YAML that somebody wrote, and back.

Numbers with an exponent are those of YAML 1.2: in 1.1, which PyYAML reads, `2e-4` is text for want
of a point.
"""

import re
from typing import Any

import yaml


class _Loader(yaml.SafeLoader): ...


class _Dumper(yaml.SafeDumper): ...


for _one in (_Loader, _Dumper):
    _one.add_implicit_resolver(
        "tag:yaml.org,2002:float",
        re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)[eE][-+]?[0-9]+$"),
        list("-+.0123456789"),
    )


def load_yaml(text: str | bytes) -> Any:
    """Numbers, text, dates, lists and dictionaries. Raises yaml.YAMLError in one line, whatever the
    text is.

    Parsed in Python: libyaml, in C, overflows its stack where brackets are nested deeply.
    """
    try:
        return _loaded(text)
    except RecursionError:
        raise yaml.YAMLError("it is nested too deeply") from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: a date such as 2027-13-01
        raise yaml.YAMLError(" ".join(str(error).split())) from error


def _loaded(text: str | bytes) -> Any:
    loader = _Loader(text)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


def dump_yaml(values: Any, *, flow: bool | None = False, width: float = 80) -> str:
    """YAML that `load_yaml` reads as the same.

    flow  all on one line; None: only what is innermost
    """
    form = {"default_flow_style": flow, "width": width, "sort_keys": False}
    return yaml.dump(values, Dumper=_Dumper, **form)
