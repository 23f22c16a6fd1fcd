"""Plain values out of YAML that somebody wrote."""

import re
from typing import Any

import yaml

POWER_OF_TEN = re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$")


class _Loader(yaml.SafeLoader):
    """YAML 1.1, with 2e-4 as the number that it is in YAML 1.2, not as text."""


_Loader.add_implicit_resolver("tag:yaml.org,2002:float", POWER_OF_TEN, list("-+0123456789"))


def plain_values(text: str | bytes) -> Any:
    """Numbers, text, dates, lists and dictionaries. Raises yaml.YAMLError in one line, whatever the
    text is.

    Parsed in Python: libyaml, in C, overflows its stack where brackets are nested deeply.
    """
    try:
        return yaml.load(text, _Loader)
    except RecursionError:
        raise yaml.YAMLError("it is nested too deeply") from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: a date such as 2027-13-01
        raise yaml.YAMLError(" ".join(str(error).split())) from error
