"""A local server that answers wandb as W&B's does, as far as runs and their rows go.

Seen with wandb 0.31: GraphQL operations by name, and the `file_stream` of rows, whose offset counts a run's rows.
"""

import json
import re
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


def project(name):
    return {"id": name, "name": name, "entity": {"id": "me", "name": "me"}}


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def log_message(self, *_):
        pass

    def do_PUT(self):  # files of a run
        self.rfile.read(int(self.headers.get("Content-Length") or 0))
        self.answer({})

    def do_POST(self):
        content = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        if self.path.endswith("/file_stream"):
            self.stream(self.path.split("/")[-2], json.loads(content))
        elif self.path.endswith("/graphql"):
            body = json.loads(content)
            name = re.search(r"(query|mutation)\s+(\w+)", body["query"])[2]
            self.answer(getattr(self, name, self.unknown)(body.get("variables") or {}))
        else:
            self.answer({})

    def answer(self, value):
        body = json.dumps(value).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def stream(self, name, body):
        run, lines = self.server.runs[name], body.get("files", {}).get("wandb-history.jsonl")
        if lines:
            offset = lines["offset"]
            run["rows"][offset : offset + len(lines["content"])] = map(json.loads, lines["content"])
        if body.get("complete") is not None:
            run["exit_code"] = body["exitcode"]
        self.answer({"exitcode": None, "limits": {}})

    def unknown(self, _):
        return {"data": None, "errors": [{"message": "not known here"}]}

    def UpsertBucket(self, given):
        run = self.server.runs.setdefault(given["name"], {"rows": []})
        run |= {name: value for name, value in given.items() if value is not None}
        bucket = {
            "id": given["name"],
            "name": given["name"],
            "displayName": run.get("displayName"),
            "description": "",
            "project": project(given["project"]),
            "config": run["config"],
            "historyLineCount": len(run["rows"]),
            "sweepName": None,
        }
        return {"data": {"upsertBucket": {"bucket": bucket, "inserted": True}}}

    def RunResumeStatus(self, given):
        run = self.server.runs.get(given["name"])
        bucket = run and {
            "id": given["name"],
            "name": given["name"],
            "displayName": run.get("displayName"),
            "config": run["config"],
            "summaryMetrics": "{}",
            "historyLineCount": len(run["rows"]),
            "historyTail": json.dumps([json.dumps(row) for row in run["rows"][-1:]]),
            "logLineCount": 0,
            "eventsLineCount": 0,
            "eventsTail": "[]",
            "tags": [],
            "wandbConfig": json.dumps({"t": 1}),
        }
        return {"data": {"model": project(given["project"]) | {"bucket": bucket}}}

    def CreateRunFiles(self, given):
        host = f"http://127.0.0.1:{self.server.server_port}"
        files = [{"name": name, "uploadUrl": f"{host}/files/{name}"} for name in given["files"]]
        return {"data": {"createRunFiles": {"runID": given["run"], "uploadHeaders": [], "files": files}}}


class Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, *_):  # a client that was killed
        pass


@contextmanager
def serving():
    """A server on this machine; yields its address and its runs by id, which it fills."""
    server = Server(("127.0.0.1", 0), Handler)
    server.runs = {}
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", server.runs
    finally:
        server.shutdown()
        server.server_close()
