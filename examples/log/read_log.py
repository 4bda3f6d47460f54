"""Print messages of a log as lines of JSON, with `mcap` and `protobuf` only: read_log.py LOG TOPIC..."""

import json
import sys
from pathlib import Path

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.json_format import MessageToDict
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader


def message_class(schema):
    """Return the class of a schema; the log contains all definitions that it needs."""
    files, pool = FileDescriptorSet.FromString(schema.data).file, DescriptorPool()
    waiting = {file.name: file for file in files}
    while waiting:  # a file comes after the files that it imports
        name = next(name for name, file in waiting.items() if not waiting.keys() & set(file.dependency))
        pool.Add(waiting.pop(name))
    return GetMessageClass(pool.FindMessageTypeByName(schema.name))


def read(path, topics):
    """Yield each message of the topics: topic, log time and publish time in ns, and its fields."""
    classes = {}
    with Path(path).open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages(topics=topics):
            if schema.id not in classes:
                classes[schema.id] = message_class(schema)
            payload = classes[schema.id].FromString(message.data)
            fields = MessageToDict(
                payload, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
            )
            yield channel.topic, message.log_time, message.publish_time, fields


if __name__ == "__main__":
    for topic, log_time_ns, publish_time_ns, fields in read(sys.argv[1], sys.argv[2:]):
        times = {"topic": topic, "log_time_ns": log_time_ns, "publish_time_ns": publish_time_ns}
        sys.stdout.write(json.dumps({**times, **fields}) + "\n")
