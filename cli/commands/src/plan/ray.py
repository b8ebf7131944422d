"""Runs a plan of b2p on Ray: each unit of work is one command line, which --resume lets be repeated."""

import json
import pathlib
import subprocess
import sys

import ray

JOB = json.loads(pathlib.Path(__file__).with_name("job.json").read_text())


@ray.remote(num_cpus=JOB["cores"], max_retries=3, retry_exceptions=True)
def run(arguments):
    """Runs one command; a worker or a command that is killed is tried again."""
    done = subprocess.run([JOB["program"], *arguments], capture_output=True, text=True)
    if done.returncode != 0:
        raise RuntimeError(f"exit code {done.returncode}: {done.stderr.strip()}")


def units(step):
    """The arguments of each unit of work of a step."""
    for group in range(step["groups"]):
        for view, orbit in enumerate(step["orbits"] or [""]):
            marks = {"{group}": str(group), "{view}": str(view), "{orbit}": orbit}
            arguments = step["arguments"]
            for mark, value in marks.items():
                arguments = [argument.replace(mark, value) for argument in arguments]
            yield arguments


def main():
    ray.init(log_to_driver=False)
    failed = 0
    for step in JOB["steps"]:
        tasks = [(arguments, run.remote(arguments)) for arguments in units(step)]
        for arguments, task in tasks:
            try:
                ray.get(task)
            except Exception as error:  # The others go on.
                failed += 1
                print(f"{' '.join(arguments)}: {error}", file=sys.stderr)
        print(f"{step['name']}: {len(tasks)} units")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
