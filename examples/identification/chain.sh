#!/bin/sh
# Design a motion, run it on the rig, fit its log, predict with the fitted law, and install it on the rig's computer, if
# RIG names one: `RIG=anna@rig ./chain.sh`, with further options of `fric deploy` in DEPLOY. Drives are simulated; on a rig,
# leave out --sim and --fast.
set -eu
fric=${FRIC:-fric}
"$fric" excite shaft.fric shaft --for 3s --limit 'v = -1 rad/s .. 1 rad/s' --limit 'a = -20 rad/s^2 .. 20 rad/s^2' \
  --evaluations 100 --output motion.fric
"$fric" hil --sim --fast --for 4s shaft_rig.fric shaft_rig
"$fric" fit shaft.fric shaft --data out/shaft_rig.friclog | tee out/shaft.txt
# The line to paste ends with the values as options.
settings=$(grep -o -e "--set '[^']*'" out/shaft.txt | tr '\n' ' ')
eval "\"$fric\" predict shaft_rig.fric shaft_dry $settings"
if [ -n "${RIG:-}" ]; then
  eval "\"$fric\" deploy \"\$RIG\" shaft_rig.fric $settings ${DEPLOY:-}"
fi
