"""Messages decoded by the schemas that come with them, by programs that did not write them."""

import json
from typing import Any


def decode_by_schema(encoding: str, name: str, schema: bytes, data: bytes) -> Any:
    """A message: by google's protobuf from the schema's descriptors, which must know every byte of it; or JSON that
    its JSON Schema accepts.
    """
    import jsonschema
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    if encoding == "json":
        content = json.loads(data)
        jsonschema.validate(content, json.loads(schema))
        return content
    pool = descriptor_pool.DescriptorPool()
    for part in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(part)  # type: ignore[no-untyped-call]
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    content = kind.FromString(data)
    known = kind.FromString(data)
    known.DiscardUnknownFields()
    assert known.ByteSize() == content.ByteSize() == len(data), name
    return content
