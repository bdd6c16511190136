"""Link the public names in docstrings, and let the search find them.

Docstrings have no links, as `help()` shows them as they are written. The separator in
`mkdocs.yml` splits names into words, so headings of other pages have the same words.
This MkDocs hook gives the entries of the API a higher weight, the fewer words the
higher. After a build it searches for each name, by the code that runs in a browser, and
fails unless its entry is the first result.
"""

import json
import pathlib
import re

from mkdocs.exceptions import PluginError
from py_mini_racer import MiniRacer

from diffrax_presym import __version__


PAGES = sorted((pathlib.Path(__file__).parent / "api").glob("*.md"))
NAMES = re.findall(
    r"^::: diffrax_presym\.([\w.]+)$",
    "\n".join(x.read_text() for x in PAGES),
    re.MULTILINE,
)
# Code that is a name, or a call of it, and no link or heading.
CODE = re.compile(r'(?<!">)<code>(?P<name>[\w.]+)(?:\([^<]*)?</code>')
# What a worker of a browser has.
WORKER = """
var self = globalThis, console = {warn() {}}, handle, reply;
var addEventListener = (_, f) => handle = f, postMessage = x => reply = x;
"""


def on_config(config):
    config.site_name += f" {__version__}"
    return config


def on_page_content(content, page, **kwargs):
    def link(match):
        name = match["name"]
        if name not in NAMES:
            return match[0]
        return f'<autoref identifier="diffrax_presym.{name}">{match[0]}</autoref>'

    is_api = page.file.src_uri.startswith("api/")
    return CODE.sub(link, content) if is_api else content


def name_of(location):
    return location.partition("#")[2].removeprefix("diffrax_presym.")


def on_page_context(context, page, config, nav):
    search = config.plugins["material/search"]
    for entry in search.search_index.entries:
        name = name_of(entry["location"])
        if name in NAMES:
            words = re.split(search.config.separator, name.rpartition(".")[2])
            entry["boost"] = 10 * 1.1 ** -len(words)


def on_post_build(config):
    site = pathlib.Path(config.site_dir)
    index = json.loads((site / "search" / "search_index.json").read_text())
    (code,) = site.glob("assets/javascripts/workers/search.*.js")
    same = lambda x, y: x.lower().replace("_", "") == y.lower().replace("_", "")
    with MiniRacer() as engine:
        engine.eval(WORKER + code.read_text() + "; 0")

        def send(kind, data):
            message = json.dumps({"data": {"type": kind, "data": data}})
            engine.eval(f"handle({message}); 0")
            return json.loads(engine.eval("JSON.stringify(reply)"))

        send(0, index | {"options": {}})
        for name in NAMES:
            queries = {f"diffrax_presym.{name}", f"dps.{name}", name}
            for query in queries | {name.rpartition(".")[2]}:
                results = send(2, query)["data"]["items"]
                first = results[0][0]["location"] if results else "none"
                # Names of the same words, such as `work_precision`, are one.
                if not same(name_of(first), name):
                    raise PluginError(f"The first result of '{query}' is {first}.")
