#!/usr/bin/env bash
# Runs a plan of `b2p plan` on Open Job Description's local runner, on a Slurm of one node and on Ray, kills a command in
# the middle of each, and compares the results, which must be equal to the bit, with nothing done twice.
#
#     tests/engines.sh [FRAMES]      runs the engines that are there: 64 frames and 4 views by default
#     tests/engines.sh install       installs them into target/tools/engines, Slurm with apt-get as root
set -euo pipefail
cd "$(dirname "$0")/.."
home=$PWD/target/tools/engines

if [ "${1:-}" = install ]; then
    python3 -m venv "$home"
    "$home/bin/pip" install --quiet --disable-pip-version-check openjd-cli==0.8.0 ray==2.60.0
    command -v slurmd > /dev/null || apt-get install -y -qq --no-install-recommends slurmctld slurmd slurm-client munge
    exit
fi

frames=${1:-64}
cargo build --locked --release -p b2p-cli
program=${CARGO_TARGET_DIR:-$PWD/target}/release/b2p
work=$(mktemp -d)
started=()
clean() {
    for daemon in "${started[@]}"; do pkill -9 -f "$daemon" || true; done
    rm -rf "$work"
}
trap clean EXIT
export PATH="$home/bin:$PATH" RAY_AUTH_MODE=disabled

# A ball that grows and turns.
mkdir "$work/clouds"
python3 - "$work/clouds" "$frames" << 'PYTHON'
import math, random, sys
folder, frames = sys.argv[1], int(sys.argv[2])
for frame in range(frames):
    rng = random.Random(frame)
    points = set()
    while len(points) < 20000:
        z, turn = rng.uniform(-1, 1), rng.uniform(0, 2 * math.pi)
        side, radius = math.sqrt(1 - z * z), 50 + 10 * frame / frames
        place = [128 + radius * v for v in (side * math.cos(turn), side * math.sin(turn), z)]
        stripe = int(127 + 120 * math.sin(6 * turn + frame / 10))
        points.add((*map(round, place), stripe, int(127 + 120 * z), 90))
    header = ["ply", "format ascii 1.0", f"element vertex {len(points)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    rows = [" ".join(map(str, point)) for point in sorted(points)]
    with open(f"{folder}/frame_{frame:04}.ply", "w") as file:
        file.write("\n".join([*header, "end_header", *rows]) + "\n")
PYTHON
cat > "$work/job.toml" << TOML
inputs = ["$work/clouds"]
encode = "--bits-per-point 2"
render = "--size 256x256 --heads surfels"
views = 4
contact-sheet = true
group = 4
cores = 1
program = "$program"
TOML

outputs() { find "$work/$1" -type f -not -path '*/.b2p/*' 2> /dev/null | sort; }

# Once a quarter of the streams are there: kills a command of this engine, and notes the files that are finished.
kill_one() { # ENGINE
    local enough=$((frames / 4 + 1))
    until [ "$(find "$work/$1/streams" -name '*.b2p' 2> /dev/null | wc -l)" -ge "$enough" ]; do sleep 0.05; done
    until pkill -9 -n -f "^$program encode .*$work/$1/"; do sleep 0.02; done
    find "$work/$1/streams" -name '*.b2p' -printf '%p %i\n' > "$work/$1.finished"
}

# Writes the plan of an engine, starts it by the command that follows, kills one of its commands, and waits for it.
try() { # ENGINE COMMAND …
    local engine=$1
    shift
    "$program" -q plan "$work/job.toml" --engine "$engine" -o "$work/plan-$engine" --to "$work/$engine"
    local start=$SECONDS
    "$@" > "$work/$engine.log" 2>&1 &
    local running=$!
    kill_one "$engine"
    # An engine that does not try again is run again: it does what is left.
    wait $running || "$@" >> "$work/$engine.log" 2>&1 || { tail -50 "$work/$engine.log" && exit 1; }
    finish "$engine" "$((SECONDS - start))"
}

# Streams that were finished when a command was killed must be the same files; all results must be there.
finish() { # ENGINE SECONDS
    local path inode
    while read -r path inode; do
        [ "$(stat -c %i "$path")" = "$inode" ] || { echo "$1: $path was made twice" >&2 && exit 1; }
    done < "$work/$1.finished"
    local count expected=$((frames * 6))
    count=$(outputs "$1" | wc -l)
    [ "$count" -eq "$expected" ] || { echo "$1: $count files, expected $expected" >&2 && exit 1; }
    (cd "$work/$1" && find . -type f -not -path '*/.b2p/*' -print0 | sort -z | xargs -0 sha256sum) > "$work/$1.sums"
    local first
    first=$(find "$work" -maxdepth 1 -name '*.sums' | sort | head -1)
    cmp "$first" "$work/$1.sums"
    echo "$1: $count files in $2 s, $(wc -l < "$work/$1.finished") streams finished before a command was killed"
}

slurm() {
    local conf=$work/daemons
    mkdir -p "$conf/state" "$conf/spool" /run/munge
    chown munge /run/munge
    pgrep -x munged > /dev/null || { su -s /bin/sh munge -c munged && started+=(munged); }
    cat > "$conf/slurm.conf" << CONF
ClusterName=one
SlurmctldHost=$(hostname)(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
CredType=cred/munge
StateSaveLocation=$conf/state
SlurmdSpoolDir=$conf/spool
SlurmctldPidFile=$conf/slurmctld.pid
SlurmdPidFile=$conf/slurmd.pid
SlurmctldLogFile=$conf/slurmctld.log
SlurmdLogFile=$conf/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
ReturnToService=2
MpiDefault=none
NodeName=$(hostname) NodeAddr=127.0.0.1 CPUs=$(nproc) State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
CONF
    export SLURM_CONF=$conf/slurm.conf
    slurmctld -c
    sleep 1
    slurmd
    started+=("slurmctld -c" slurmd)
    until sinfo -h -t idle 2> /dev/null | grep -q idle; do sleep 0.2; done
}

submit_and_wait() {
    sh "$1/submit.sh"
    while [ -n "$(squeue -h)" ]; do sleep 1; done
}

if command -v openjd > /dev/null; then
    try openjd openjd run "$work/plan-openjd/job.template.json"
else
    echo "skipped: openjd; tests/engines.sh install"
fi
if command -v slurmd > /dev/null && [ "$(id -u)" = 0 ]; then
    slurm
    try slurm submit_and_wait "$work/plan-slurm"
else
    echo "skipped: Slurm; tests/engines.sh install, as root"
fi
if "$home/bin/python" -c 'import ray' 2> /dev/null; then
    try ray "$home/bin/python" "$work/plan-ray/job.py"
else
    echo "skipped: Ray; tests/engines.sh install"
fi
