#!/bin/bash
# A Slurm job: one process for each GPU of two nodes. Submit it by `sbatch examples/several_processes.sh`, from
# an environment in which jaxvol is installed.
#SBATCH --job-name=jaxvol
#SBATCH --nodes=2
#SBATCH --ntasks-per-node=4
#SBATCH --gpus-per-task=1
#SBATCH --cpus-per-task=8
#SBATCH --time=00:10:00

srun python examples/several_processes.py --resolution 512 --size 2048 --output head.png
