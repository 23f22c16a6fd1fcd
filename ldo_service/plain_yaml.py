"""Plain values out of YAML that somebody wrote."""

from typing import Any

import yaml


def plain_values(text: str | bytes) -> Any:
    """Numbers, text, dates, lists and dictionaries. Raises yaml.YAMLError in one line, whatever the
    text is.

    Parsed in Python: libyaml, in C, overflows its stack where brackets are nested deeply.
    """
    try:
        return yaml.safe_load(text)
    except RecursionError:
        raise yaml.YAMLError("it is nested too deeply") from None
    except (yaml.YAMLError, ValueError) as error:  # ValueError: a date such as 2027-13-01
        raise yaml.YAMLError(" ".join(str(error).split())) from error
