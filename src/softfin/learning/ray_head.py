"""A Ray cluster of this machine alone, for as long as standard input stays open; prints its address.

Run as a script, in a process that knows nothing of JAX: Ray forks, and JAX's threads do not survive that.
"""

import os
import sys

if __name__ == "__main__":
    import ray

    started = ray.init(
        "local",
        include_dashboard=False,
        _node_ip_address="127.0.0.1",
        object_store_memory=int(sys.argv[1]),
        log_to_driver=False,
        logging_level="ERROR",
    )
    os.write(sys.stdout.fileno(), f"{started.address_info['gcs_address']}\n".encode())
    sys.stdin.read()
    ray.shutdown()
