"""Signs the next certificate of one identity.

The hub starts this process, so that the hub itself need not load the authority's key.

This process reads one request from stdin and writes the certificate to stdout, or the reason why there is none to
stderr: `python -m fleet.hub.renewals --endpoint tls/127.0.0.1:7447 --identity person.mia`. Without an identity it
renews the hub's own certificate, if that is due.
"""

import argparse
import json
import sys
from datetime import UTC, datetime

from fleet.hub.certificate_authority import BadRequestForCertificate
from fleet.hub.hub_store import HubStore
from schemas.bus import BusError
from schemas.bus.certificate_request import CERTIFICATE, REQUEST
from schemas.bus.hub_renewals import MAX_RENEWAL_BYTES


def main() -> int:
    """Sign one certificate. Return 0 if it is made, or if that of the hub is not due; 1 if it cannot be made."""
    parser = argparse.ArgumentParser(prog="python -m fleet.hub.renewals", description=__doc__)
    parser.add_argument("--endpoint", required=True)
    parser.add_argument("--identity", default="")
    arguments = parser.parse_args()
    now = datetime.now(UTC)
    try:
        store = HubStore.of(arguments.endpoint)
        if not arguments.identity:
            store.renew_hub(now)
            return 0
        asked = json.loads(sys.stdin.buffer.read(MAX_RENEWAL_BYTES))
        certificate, request = str(asked[CERTIFICATE]).encode(), str(asked[REQUEST]).encode()
        sys.stdout.buffer.write(store.renew(certificate, request, arguments.identity, now))
    except (BadRequestForCertificate, BusError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    except (ValueError, KeyError, TypeError):
        sys.stderr.write("it is not a request for a certificate\n")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
