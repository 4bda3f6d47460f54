"""An RTSP server for Debian's own Python, with the library of GStreamer.

    /usr/bin/python3 rtsp_server.py VIDEO PAYLOADER PROTOCOL AUTHENTICATION

VIDEO is an MP4 file, sent once to each client. PAYLOADER is the element that makes packets of its frames.
PROTOCOL is ``tcp`` or ``udp``. AUTHENTICATION is ``none``, ``basic`` or ``digest`` (admin, hush). The server
prints its port.
"""

from __future__ import annotations

import sys

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtsp", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtsp, GstRtspServer  # noqa: E402


def guard(server: GstRtspServer.RTSPServer, method: str) -> GstRtspServer.RTSPPermissions:
    """Allow only the user admin."""
    token, auth = GstRtspServer.RTSPToken.new(), GstRtspServer.RTSPAuth.new()
    token.set_string("media.factory.role", "admin")
    if method == "basic":
        auth.add_basic(GstRtspServer.RTSPAuth.make_basic("admin", "hush"), token)
    else:
        auth.set_supported_methods(GstRtsp.RTSPAuthMethod.DIGEST)
        auth.add_digest("admin", "hush", token)
    server.set_auth(auth)
    permissions = GstRtspServer.RTSPPermissions.new()
    permissions.add_permission_for_role("admin", "media.factory.access", True)
    permissions.add_permission_for_role("admin", "media.factory.construct", True)
    return permissions


def main(video: str, payloader: str, protocol: str, authentication: str) -> None:
    Gst.init(None)
    server = GstRtspServer.RTSPServer.new()
    server.set_address("127.0.0.1")
    server.set_service("0")
    factory = GstRtspServer.RTSPMediaFactory.new()
    factory.set_launch(f'( filesrc location="{video}" ! qtdemux ! {payloader} name=pay0 )')
    factory.set_protocols({"tcp": GstRtsp.RTSPLowerTrans.TCP, "udp": GstRtsp.RTSPLowerTrans.UDP}[protocol])
    if authentication != "none":
        factory.set_permissions(guard(server, authentication))
    server.get_mount_points().add_factory("/live", factory)
    server.attach(None)
    print(server.get_bound_port(), flush=True)  # noqa: T201
    GLib.MainLoop().run()


main(*sys.argv[1:])
