"""Pages of studies: templates (``*.html.j2``) beside the code that hands them their values.

``figures/page.html.j2`` is what all pages have, ``figures/parts.html.j2`` how they show figures and
tables. What is handed in is text: markup in it is escaped, and a value that is missing is an error.
"""

from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def page(template: str, **values: Any) -> str:
    """The page of a template, named by its path in ``companion/studies``."""
    return _environment().get_template(template).render(values)


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("companion.studies", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
