"""Process that reads a key and is stopped by a test. Arguments: its endpoint and the key."""

import sys
import time

import zenoh

from ldo_service.transport.zenoh_transport import Endpoint, open_session

if __name__ == "__main__":
    with open_session(Endpoint("test", sys.argv[1])) as session:
        handler = zenoh.handlers.Callback(lambda _sample: None, indirect=False)
        session.declare_subscriber(sys.argv[2], handler)
        print("up", flush=True)
        time.sleep(1e6)
