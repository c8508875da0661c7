"""What Chromium makes of pages: a folder is served here, and a script measures its pages in one run of the browser."""

import functools
import json
import shutil
import subprocess
import threading
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PREFIX = "/sub/path/"  # as where several projects share a host
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--window-size=1500,1000")
OFFLINE = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"
VISIT = """<!doctype html><script type="module">
const frame = document.createElement("iframe"), found = []
document.body.append(frame)
frame.style.border = 0
frame.style.height = "900px"
for (const page of PAGES) {
  for (const width of WIDTHS) {
    frame.style.width = width + "px"
    if (width == WIDTHS[0]) await new Promise(done => { frame.onload = done; frame.src = PREFIX + page })
    await new Promise(done => setTimeout(done, 50))
    found.push([page, width, (MEASURE)(frame.contentDocument, frame.contentWindow)])
  }
}
await fetch(PREFIX + "found", { method: "POST", body: JSON.stringify(found) })
</script>"""


def visit(site: Path, pages: list[str], widths: list[int], measure: str, profile: Path, seconds: float = 600) -> Any:
    """Return each page with a width [px] and what the JavaScript function `measure(document, window)` returns.

    The list of the console's lines comes second. The browser reaches no other host.
    """
    given = {"PAGES": pages, "WIDTHS": widths, "PREFIX": PREFIX}
    parts = {name: json.dumps(value) for name, value in given.items()} | {"MEASURE": measure}
    program = functools.reduce(lambda text, part: text.replace(*part), parts.items(), VISIT)
    answered, found = threading.Event(), []

    class Handler(SimpleHTTPRequestHandler):
        def do_GET(self):
            place = self.path.partition("?")[0].removeprefix(PREFIX)
            if place == "visit":
                return self.reply(200, program.encode())
            if self.path.startswith(PREFIX) and (site / place).is_file():
                self.path = f"/{place}"
                return super().do_GET()
            return self.reply(404, (site / "404.html").read_bytes())

        def do_POST(self):
            found.extend(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            answered.set()
            self.reply(200, b"")

        def reply(self, code: int, content: bytes) -> None:
            self.send_response(code)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format, *arguments):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(site))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}{PREFIX}visit"
        log = profile / "console.txt"
        with log.open("w") as said:
            command = [str(BROWSER), *FLAGS, OFFLINE, f"--user-data-dir={profile}", address]
            browser = subprocess.Popen(command, stderr=said, stdout=said)
            answered.wait(seconds)
            browser.terminate()
            browser.wait()
        server.shutdown()
    assert answered.is_set(), log.read_text()
    return found, [line for line in log.read_text().splitlines() if ":CONSOLE" in line]
