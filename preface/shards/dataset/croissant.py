"""The dataset as Croissant describes one: JSON-LD that dataset catalogues and search engines read.

MLCommons, "Croissant Format Specification 1.0", https://docs.mlcommons.org/croissant/docs/croissant-spec.html. The
files are listed with their digests; the identities are an inline record set, since no Croissant extraction reads
tensors out of safetensors files.
"""

from __future__ import annotations

import json
from typing import Any

from preface.shards.dataset.data_card import Contents

CROISSANT_FILE = "croissant.json"

_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
_FIELDS = (
    ("identity", "sc:Text", "The name of the person."),
    ("split", "sc:Text", "train or holdout."),
    ("take", "sc:Text", "The take that the person was captured in."),
    ("views", "sc:Integer", "How many views there are."),
    ("shard", "sc:Text", "The file that the person is in."),
)


def croissant(contents: Contents) -> str:
    """The description, JSON-LD, the same for the same dataset."""
    chosen = contents.configuration
    files = [
        {
            "@type": "cr:FileObject",
            "@id": name,
            "name": name,
            "contentUrl": name,
            "contentSize": f"{size} B",
            "encodingFormat": "application/octet-stream",
            "sha256": digest,
        }
        for name, (size, digest) in contents.files.items()
    ]
    rows = [
        {
            f"identities/{field}": value
            for field, value in (
                ("identity", entry.identity),
                ("split", entry.split),
                ("take", entry.take),
                ("views", entry.views),
                ("shard", entry.file),
            )
        }
        for entry in contents.entries
    ]
    record_set = {
        "@type": "cr:RecordSet",
        "@id": "identities",
        "name": "identities",
        "description": "Who is in the dataset.",
        "key": {"@id": "identities/identity"},
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"identities/{name}",
                "name": f"identities/{name}",
                "description": description,
                "dataType": kind,
            }
            for name, kind, description in _FIELDS
        ],
        "data": rows,
    }
    described = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "name": contents.name,
        "description": f"{len(contents.entries)} heads in {contents.views} posed views of "
        f"{chosen.width}x{chosen.height} pixels, with cameras in one canonical frame; see README.md.",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "distribution": files,
        "recordSet": [record_set],
    }
    return json.dumps(described, indent=2, ensure_ascii=False) + "\n"
