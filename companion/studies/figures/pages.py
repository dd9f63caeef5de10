"""Pages of studies from templates (``*.html.j2``), which lie beside the code that uses them.

``figures/page.html.j2`` is the common base, ``figures/parts.html.j2`` renders figures and tables.
Values are text: markup in them is escaped, and a missing value is an error.
"""

from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined


def page(template: str, **values: Any) -> str:
    """Render a template, named by its path in ``companion/studies``."""
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
