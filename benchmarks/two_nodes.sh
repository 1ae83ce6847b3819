#!/bin/bash
# Trains on two nodes that share nothing but a network cable: two network
# namespaces of this machine (root needed; Debian package iproute2).
#
#   benchmarks/two_nodes.sh         a tiny run
#   KILL=1 benchmarks/two_nodes.sh  and node 1 dies in the middle, once
#
# Ends with the checksum of the network that each node has learned, and with an
# error if they differ.
set -euo pipefail
cd "$(dirname "$0")/.."
root=$PWD
python=${PYTHON:-$root/.venv/bin/python}
steps=${STEPS:-3200}
names=("dmc$$a" "dmc$$b")
work=$(mktemp -d)
nodes=()

clean() {
  ((${#nodes[@]})) && kill "${nodes[@]}" 2>/dev/null && wait "${nodes[@]}"
  for name in "${names[@]}"; do ip netns del "$name" 2>/dev/null; done
  rm -rf "$work"
}
trap clean EXIT

for i in 0 1; do
  ip netns add "${names[i]}"
  ip -n "${names[i]}" link set lo up
done
ip link add cable netns "${names[0]}" type veth peer cable netns "${names[1]}"
for i in 0 1; do
  ip -n "${names[i]}" addr add "10.77.0.$((i + 1))/24" dev cable
  ip -n "${names[i]}" link set cable up
done

# The binary; every node also writes down what it has learned.
cat >"$work/node.py" <<'PYTHON'
import os
import pathlib

import safetensors.torch

from dmc_multimode.bin import train

loop = train.training.TrainingLoop
run = loop.run
folder = pathlib.Path(__file__).parent
(folder / f'pid{os.environ["NODE"]}').write_text(str(os.getpid()))


def run_and_note(self, *args):
  run(self, *args)
  weights = self._learner.network.state_dict()
  # Without metadata, whose order in the file is drawn anew by every process.
  path = folder / f'network{os.environ["NODE"]}'
  safetensors.torch.save_file(weights, path)


loop.run = run_and_note
train.cli()
PYTHON

# Each node has a disk of its own, too: only that of rank 0 is written to.
for i in 0 1; do
  # TORCH_DISABLE_...: restarts hang without in torch 2.13. is_host, local_addr:
  # both nodes have the name of this machine, which tells them nothing.
  NODE=$i PYTHONPATH=$root GLOO_SOCKET_IFNAME=cable \
    TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1 OMP_NUM_THREADS=1 \
    ip netns exec "${names[i]}" "$python" -m torch.distributed.run \
    --nnodes=2 --nproc_per_node=1 --max_restarts=3 \
    --rdzv_backend=c10d --rdzv_endpoint=10.77.0.1:29400 --rdzv_id=two_nodes \
    --rdzv_conf="is_host=$((1 - i))" --local_addr="10.77.0.$((i + 1))" \
    "$work/node.py" --run_dir="$work/run" --steps="$steps" --threads=1 \
    --num_worlds=8 --ppo_rollout_length=4 --ppo_hidden_sizes=16 \
    --modes=idle,walk_forward --one_hot >"$work/log$i" 2>&1 &
  nodes+=($!)
done

if [[ ${KILL:-} ]]; then
  # Between two rows of the log, with no checkpoint yet or with one.
  until [[ -s $work/run/metrics.csv ]]; do sleep 0.1; done
  echo "killing node 1 after $(($(wc -l <"$work/run/metrics.csv") - 1)) rows"
  kill -9 "$(cat "$work/pid1")"
fi

failed=0
for node in "${nodes[@]}"; do wait "$node" || failed=1; done
nodes=()
for i in 0 1; do
  echo "--- node $i"
  tr '\r' '\n' <"$work/log$i" | grep -E 'steps; |Resuming|error' || true
done
if ((failed)); then
  tail -n 30 "$work"/log?
  exit 1
fi
(cd "$work" && sha256sum network0 network1)
cmp "$work/network0" "$work/network1" && echo 'both nodes hold one network'
