"""Reading and writing of YAML files that users write.

This module reads `2e-4` as a number, as YAML 1.2 requires. PyYAML itself follows YAML 1.1, which
reads `2e-4` as text because the decimal point is missing.
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
    """Parse YAML into numbers, text, dates, lists and dictionaries.

    The function uses PyYAML's pure-Python parser, because libyaml (C) overflows its stack on deeply
    nested brackets.

    Raises:
        yaml.YAMLError: The text is malformed; the message has one line. No other exception occurs.
    """
    try:
        return _loaded(text)
    except RecursionError:
        raise yaml.YAMLError("the YAML is nested too deeply; use fewer levels") from None
    except (yaml.YAMLError, ValueError) as error:  # A date such as 2027-13-01 is a ValueError.
        raise yaml.YAMLError(" ".join(str(error).split())) from error


def _loaded(text: str | bytes) -> Any:
    loader = _Loader(text)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


def dump_yaml(values: Any, *, flow: bool | None = False, width: float = 80) -> str:
    """Write values as YAML that `load_yaml` reads back unchanged.

    Args:
        values: Numbers, text, dates, lists and dictionaries.
        flow: True: all values on one line. None: one line per innermost list or dictionary. False:
            one line per value.
        width: Maximum line width in columns.
    """
    form = {"default_flow_style": flow, "width": width, "sort_keys": False}
    return yaml.dump(values, Dumper=_Dumper, **form)
