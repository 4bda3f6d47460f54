"""An S3 server on loopback, and a bucket in it, for the tests of logs in object stores."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest


@contextmanager
def serve_s3() -> Iterator[str]:
    """Serve S3 on loopback; yield the address."""
    from moto.server import ThreadedMotoServer

    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    yield f"http://{host}:{port}"
    server.stop()


@contextmanager
def open_bucket(address: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Yield a bucket ``logs``; the environment names its server, as a user does."""
    import boto3
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "testing")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.setenv("AWS_ENDPOINT_URL", address)
    bucket = boto3.resource("s3").create_bucket(Bucket="logs")
    yield bucket
    bucket.objects.all().delete()
    bucket.delete()


def put(bucket: Any, key: str, data: bytes) -> str:
    """Write an object; return its URL."""
    bucket.put_object(Key=key, Body=data)
    return f"s3://logs/{key}"
