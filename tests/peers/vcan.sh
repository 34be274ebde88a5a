#!/usr/bin/env bash
# The programs of others and ours on vcan0, which this makes: vcan.sh FRIC PYTHON. Prints what each of the scripts saw.
set -euo pipefail
fric=$1 python=$2
here=$(dirname "$0")
cd "$(mktemp -d)"
export PYTHONDONTWRITEBYTECODE=1
# The guest has busybox beside it for a host that lacks iproute2.
ip=$(command -v ip || echo "$here/../can/cache/root/bin/busybox ip")
$ip link add dev vcan0 type vcan
$ip link set vcan0 up

# Their master, our drives.
"$fric" drives "$here/node.fric" drive --bus can0=vcan0 --quiet 2>drives &
drives=$!
until grep -q simulated drives; do sleep 0.1; done
"$python" "$here/master.py" vcan0
kill $drives
wait $drives || true

# Our master, their drive. On an emulated processor an answer may miss a period: what is missed is counted.
mkfifo ask
"$python" "$here/node.py" vcan0 <ask >seen &
node=$!
exec 3>ask
until grep -q ready seen; do sleep 0.1; done
"$fric" hil "$here/node.fric" node --bus can0=vcan0 --arm --accept-jitter --count-overruns --for 4s --quiet --log log
"$fric" replay log
exec 3>&-
wait $node
cat seen
