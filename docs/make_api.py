"""Write docs/api.md, the reference of the HTTP API, from its OpenAPI document.

    python docs/make_api.py [--check]

With --check nothing is written; status 1 says that the page is not up to date.
"""

import sys
from pathlib import Path
from typing import Any, Final

from httpx import Response
from starlette.testclient import TestClient

from companion.node.service import Service
from companion.server.app import create_app
from companion.settings.model import Settings

PAGE: Final = Path(__file__).resolve().parent / "api.md"
HEAD: Final = """# The API

Every path and every field, with units; a running service shows the same at `/docs`, where requests
can be tried. Written by `python docs/make_api.py`.

"""
Json = dict[str, Any]


def answer(path: str) -> Response:
    """The answer to a GET of a service that receives nothing."""
    settings = Settings().override(
        center={"source": "0,0,0"}, links={"urls": ["udpin:127.0.0.1:0"]}
    )
    with TestClient(
        create_app(Service(settings=settings, say=print)), "http://localhost"
    ) as client:
        return client.get(path)


def document() -> Json:
    """The OpenAPI document."""
    found: Json = answer("/openapi.json").json()
    return found


def kind(schema: Json) -> str:
    """The type of a field in a word or two; what it refers to as a link."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if "anyOf" in schema:
        return " or ".join(kind(one) for one in schema["anyOf"])
    if "enum" in schema:
        return ", ".join(f"`{word}`" for word in schema["enum"])
    if "const" in schema:
        return f"`{schema['const']}`"
    if schema.get("type") == "array":
        return f"list of {kind(schema.get('items', {}))}"
    if isinstance(schema.get("additionalProperties"), dict):
        return f"object of {kind(schema['additionalProperties'])}"
    return str(schema.get("type", "any"))


def cell(text: str) -> str:
    """Text within a table."""
    return " ".join(text.replace("|", "\\|").split())


def page(found: Json) -> str:
    """The page in Markdown."""
    parts = [HEAD, found["info"]["description"].strip(), "\n\n## Paths\n"]
    for path, operations in found["paths"].items():
        ((method, shown),) = operations.items()
        parts.append(f"\n### {method.upper()} {path}\n\n{shown['summary']}.\n")
        if shown.get("parameters"):
            parts.append("\n| parameter | type | meaning |\n|---|---|---|\n")
            for one in shown["parameters"]:
                means = f"{kind(one['schema'])} | {cell(one.get('description', ''))}"
                parts.append(f"| `{one['name']}` | {means} |\n")
        if "requestBody" in shown:
            body = shown["requestBody"]
            ((media, content),) = body["content"].items()
            parts.append(f"\nBody `{media}`: {kind(content['schema'])} ({body['description']}).\n")
        answers = [
            f"{status}: " + ", ".join(
                f"`{media}`" + (f" {kind(body['schema'])}" if body.get("schema") else "")
                for media, body in answer.get("content", {}).items()
            )
            for status, answer in shown["responses"].items()
        ]  # fmt: skip
        parts.append("\nAnswers " + "; ".join(answers) + ".\n")
    parts.append("\n## Answers and bodies\n")
    for name, schema in sorted(found["components"]["schemas"].items()):
        parts.append(f"\n### {name}\n\n{cell(schema.get('description', ''))}\n")
        if schema.get("properties"):
            parts.append("\n| field | type | meaning |\n|---|---|---|\n")
            for field, said in schema["properties"].items():
                means = f"{kind(said)} | {cell(said.get('description', ''))}"
                parts.append(f"| `{field}` | {means} |\n")
    return "".join(parts)


def main() -> None:
    """Write the page, or check it."""
    text = page(document())
    if "--check" in sys.argv[1:]:
        if not PAGE.exists() or PAGE.read_text(encoding="utf-8") != text:
            sys.exit(f"{PAGE.name} is not up to date: python docs/make_api.py")
        return
    PAGE.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
