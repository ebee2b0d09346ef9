"""The templates of all report pages."""

from __future__ import annotations

from typing import Any

import jinja2


def render(template: str, context: dict[str, Any], **names: Any) -> str:
    """Fill in a template.

    Args:
        template: Its file below ``templates``.
        context: What it shows; a name that is missing is an error.
        names: What it calls.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("imagine_bench.report"),
        autoescape=template.endswith(".html.j2"),
        trim_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.globals.update(names)
    return environment.get_template(template).render(context)
