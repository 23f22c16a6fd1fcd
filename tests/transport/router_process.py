"""Router in its own process, which a test stops and continues. Argument: its endpoint."""

import sys
import time

from ldo_service.transport.zenoh_transport import Endpoint, open_session

if __name__ == "__main__":
    with open_session(Endpoint("test", sys.argv[1]), router=True):
        print("up", flush=True)
        time.sleep(1e6)
