"""The folder of a bundle, read and ready to run, when it is as it was exported."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from torchrl_quad.deploy.contract import (
    VERSION,
    Arrays,
    BrokenPolicy,
    Contract,
    TamperedBundle,
    UnknownContract,
    digest,
    files,
    problem,
    sha256,
)
from torchrl_quad.errors import needing, one_line, shown

AGAIN = "Export the policy again."


class Graph:
    """A graph of a bundle, ready to run.

    Args:
        path: where it came from.
        content: ONNX.
        about: what the contract says of it: ``reads`` and ``writes``.

    Raises:
        TamperedBundle: onnxruntime cannot read it.
        ImportError: onnxruntime is missing.
    """

    def __init__(self, path: Path, content: bytes, about: Contract) -> None:
        with needing("A bundle flies with onnxruntime: pip install onnxruntime"):
            import onnxruntime
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        try:
            own = {"providers": ["CPUExecutionProvider"], "enable_fallback": 0}  # the fallback prints
            self.session = onnxruntime.InferenceSession(content, options, **own)
        except Exception as error:  # onnxruntime has a dozen kinds, with nothing else in common
            raise TamperedBundle(f"{path}: onnxruntime cannot read it: {one_line(error)}. {AGAIN}") from error
        self.name, self.reads = path.stem, [*about["reads"]]
        self.writes = {name: tuple(x["shape"]) for name, x in about["writes"].items()}

    def __call__(self, given: Arrays) -> Arrays:
        """What the graph makes of arrays (n, ...), by name; what it does not read is ignored.

        Raises:
            BrokenPolicy: it fails, or answers in other shapes than the contract says.
        """
        try:
            found: Any = self.session.run([*self.writes], {name: given[name] for name in self.reads})
        except Exception as error:  # see above
            raise BrokenPolicy(f"onnxruntime cannot run {self.name}.onnx: {one_line(error)}.") from error
        count = len(given[self.reads[0]])
        if [x.shape for x in found] != [(count, *shape) for shape in self.writes.values()]:
            shapes = ", ".join(str(x.shape) for x in found)
            raise BrokenPolicy(f"{self.name}.onnx answered arrays of the shapes {shapes}.")
        return dict(zip(self.writes, found, strict=True))


def read(folder: Path) -> tuple[Contract, dict[str, Graph], Arrays, Arrays]:
    """The contract, the graphs, the vectors and the starts of a bundle, when every checksum fits.

    Raises:
        FileNotFoundError: there is no contract in the folder.
        UnknownContract: it has another version, or does not fit the schema.
        TamperedBundle: a file is not as it was exported, or no contract at all.
        ImportError: onnxruntime or jsonschema is missing.
    """
    path = folder / "contract.json"
    if not path.is_file():
        raise FileNotFoundError(
            f"No bundle at {folder}: it has no contract.json. Export one: "
            "python recipes/export.py checkpoint=.../checkpoint.pt"
        )
    try:
        contract = json.loads(path.read_bytes())
        version, fits = contract["version"], digest(contract) == contract["digest"]
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        why = f"it lacks {error}" if isinstance(error, KeyError) else one_line(error)
        raise TamperedBundle(f"{path} is no contract of a policy, or is damaged: {why}. {AGAIN}") from error
    package = contract.get("origin", {}).get("package", "another version")
    written = f"It was written by {package}: use that one, or export again."
    if version != VERSION:
        raise UnknownContract(f"{path} has version {shown(version)}, and this torchrl_quad reads {VERSION}. {written}")
    changed = f"was changed after the export: its checksum does not fit. {AGAIN}"
    if not fits:
        raise TamperedBundle(f"{path} {changed}")
    if said := problem(contract):
        raise UnknownContract(f"{path}: {said}. This torchrl_quad cannot fly it. {written}")
    content = {}
    for name in files(contract):
        try:
            content[name] = (folder / name).read_bytes()
        except OSError as error:
            raise TamperedBundle(f"{folder / name} cannot be read: {error.strerror}. {AGAIN}") from error
        if sha256(content[name]) != contract["sha256"][name]:
            raise TamperedBundle(f"{folder / name} {changed}")
    graphs = {
        name: Graph(folder / f"{name}.onnx", content[f"{name}.onnx"], x) for name, x in contract["graphs"].items()
    }
    vectors, starts = (dict(np.load(io.BytesIO(content[name]))) for name in ("vectors.npz", "starts.npz"))
    return contract, graphs, vectors, starts
