"""Write JPEG files into a log: python write_log.py LOG CAMERA RATE_HZ FILE...

It needs `mcap` and `foxglove-schemas-protobuf`, and not ipsys.
"""

import sys
import time
from pathlib import Path

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.writer import CompressionType, Writer


def schema_of(message):
    """Return the definition of a message and of all files that it imports, as a log stores it."""
    found = {}

    def add(file):
        for imported in file.dependencies:
            add(imported)
        found[file.name] = file

    add(message.DESCRIPTOR.file)
    files = FileDescriptorSet()
    for file in found.values():
        file.CopyToProto(files.file.add())
    return files.SerializeToString()


def write(path, camera, rate_hz, images, start_ns):
    """Write the images of one camera; the times are in ns since 1970."""
    with Path(path).open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE)  # JPEG does not compress
        writer.start()
        name = CompressedImage.DESCRIPTOR.full_name
        schema = writer.register_schema(name, "protobuf", schema_of(CompressedImage))
        channel = writer.register_channel(f"/cameras/{camera}/image", "protobuf", schema)
        for number, image in enumerate(images):
            time_ns = start_ns + int(number * 1e9 / rate_hz)
            message = CompressedImage(data=image, format="jpeg", frame_id=camera)
            message.timestamp.FromNanoseconds(time_ns)
            writer.add_message(channel, time_ns, message.SerializeToString(), time_ns)
        writer.finish()


if __name__ == "__main__":
    log, camera, rate_hz, *files = sys.argv[1:]
    write(log, camera, float(rate_hz), [Path(name).read_bytes() for name in files], time.time_ns())
