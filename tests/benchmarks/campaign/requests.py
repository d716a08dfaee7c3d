"""Requests that the OpenAPI schema describes, with values at its bounds and beyond them."""

from __future__ import annotations

import random
import re
from pathlib import Path
from typing import Any
from urllib.parse import quote

from tests.benchmarks.campaign import Result
from tests.benchmarks.campaign.service import BROWSER, SHORT_RUN, Service

REQUESTS = 300
#: These start computations of minutes; only the routes that stop and read them are requested.
_HEAVY = {("post", "/api/learning"), ("post", "/api/search"), ("post", "/api/search/go-on")}
_WILD = 0.08  # share of values that ignore the schema
_STRANGE: tuple[Any, ...] = (
    None, True, -1, 0, 2**31, 2**63, -1e308, 1e-300, "", "\0", "../../etc/passwd", "é\U0001f332" * 20,
    "x" * 5000, [], {}, [[[[]]]], {"a": {"b": None}},
)  # fmt: skip
#: Values that pass more checks than random ones, by the name of the field.
_KNOWN: dict[str, tuple[Any, ...]] = {
    "uri": (
        SHORT_RUN,
        "sim:paper",
        "sim:nowhere",
        "/proc/self/mem",
        "zenoh:tcp/127.0.0.1:1",
        "~nobody9/x.mcap",
    ),
    "browser": (BROWSER,),
    "who": ("Ann", "Bob"),
    "name": ("forest", "paper", "mine"),
    "suffix": ("csv", "geojson", "gpkg", "dxf", "xlsx", "pdf"),
    "changes": ({"clustering.eps": 0.3}, {"slam.particles": 1}, {"detection.e_max": 1e12}),
    "table": ("x_m,y_m,dbh_cm\n1,2,30\n", "x,y\n1e200,0\n"),
}


def run(turn: int, folder: Path) -> Result:
    """Send requests in a random order to one server, then map a run as if nothing had happened."""
    result, rng = Result(), random.Random(turn)
    with Service(result, SHORT_RUN, folder / f"requests{turn}") as service:
        undisturbed = service.map_of(SHORT_RUN)
        schema = service.web.get("/api/openapi.json").json()
        routes = [
            (method, path, route)
            for path, methods in schema["paths"].items()
            for method, route in methods.items()
            if (method, path) not in _HEAVY
        ]
        number = service.run_number()
        known = {
            **_KNOWN,
            "run": (number,),
            "a": (number,),
            "b": (number,),
            "key": (number, "x"),
            "number": (1, 2),
        }
        draw = _Draw(schema, known, rng)
        for _ in range(REQUESTS):
            method, path, route = rng.choice(routes)
            query = {}
            for parameter in route.get("parameters", ()):
                text = str(draw.value(parameter["schema"], parameter["name"]))
                if parameter["in"] == "path":
                    path = re.sub(r"\{" + parameter["name"] + r"(:path)?\}", quote(text, safe=""), path)
                elif parameter.get("required") or rng.random() < 0.5:
                    query[parameter["name"]] = text
            words = "&".join(f"{name}={quote(text, safe='')}" for name, text in query.items())
            content = route.get("requestBody", {}).get("content", {}).get("application/json")
            body = None if content is None else draw.value(content["schema"])
            service.ask(method.upper(), f"{path}?{words}" if words else path, body)
            result.done += 1
        for path in ("/api/search/stop", "/api/sensitivity", "/api/learning"):
            service.ask("POST" if path.endswith("stop") else "DELETE", path)
        if service.map_of(SHORT_RUN) != undisturbed:
            result.faults.append("another map than before the requests")
    return result


class _Draw:
    """Draws values of a JSON schema.

    Args:
        root: The document, in which references are looked up.
        known: Values by the name of the field.
        rng: Random numbers.
    """

    def __init__(self, root: dict[str, Any], known: dict[str, tuple[Any, ...]], rng: random.Random) -> None:
        self._root, self._known, self._rng = root, known, rng

    def value(self, schema: dict[str, Any], name: str = "", depth: int = 0) -> Any:
        """Return a value of a schema, or one that ignores it."""
        rng = self._rng
        if depth and (rng.random() < _WILD or depth > 6):
            return rng.choice(_STRANGE)
        if name in self._known and rng.random() < 0.7:
            return rng.choice(self._known[name])
        if "$ref" in schema:
            found: Any = self._root
            for part in schema["$ref"].removeprefix("#/").split("/"):
                found = found[part]
            return self.value(found, name, depth)
        for kind in ("anyOf", "oneOf", "allOf"):
            if kind in schema:
                return self.value(rng.choice(schema[kind]), name, depth + 1)
        if "const" in schema or "enum" in schema:
            return rng.choice(schema.get("enum", [schema.get("const")]))
        match schema.get("type"):
            case "object":
                required, fields = schema.get("required", ()), schema.get("properties", {})
                content = {
                    field: self.value(inner, field, depth + 1)
                    for field, inner in fields.items()
                    if rng.random() < (0.97 if field in required else 0.5)
                }
                if isinstance(schema.get("additionalProperties"), dict) and rng.random() < 0.7:
                    content["clustering.eps"] = self.value(schema["additionalProperties"], "", depth + 1)
                return content
            case "array":
                inner = schema.get("prefixItems") or [schema.get("items", {})] * rng.choice((0, 1, 3))
                return [self.value(each, name, depth + 1) for each in inner]
            case "integer" | "number" as kind:
                low, high = schema.get("minimum", -(2**31)), schema.get("maximum", 2**31)
                drawn = rng.choice((low, high, low - 1, high + 1, 0, 1, rng.uniform(low, high)))
                return int(drawn) if kind == "integer" else float(drawn)
            case "boolean":
                return rng.random() < 0.5
            case "string":
                return rng.choice(
                    ("", "a", "Stand 3", "x" * int(schema.get("maxLength", 100)), "\u202e", BROWSER)
                )
            case "null":
                return None
        return rng.choice(_STRANGE)
