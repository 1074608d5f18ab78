"""A trainer of somebody else: it reads shards with `preface.shards` and knows nothing else of this project.

    python tools/train_elsewhere.py shards/ [--steps 200] [--device cuda]

A small network learns the colour of a ray from its origin and direction. It is no good as a head; it shows that
the reader is all that another trainer needs (numpy, torch, google-crc32c; the files are safetensors), and what
a batch is. Prints the loss as it goes down.
"""

import argparse

import torch

from preface.shards import Dataset, Loader, PaperPattern


def train(shards: str, steps: int, device: str, identities: int) -> list[float]:
    """Train and return the loss, mean squared error of sRGB-encoded colours, of each step."""
    with Dataset(shards) as dataset:
        sampler = PaperPattern(dataset.index("train"), seed=0, identities=identities)
        loader = Loader(dataset, sampler, device, scale=dataset.manifest.scene_scale)
        torch.manual_seed(0)
        layers = [torch.nn.Linear(9, 64), torch.nn.ReLU(), torch.nn.Linear(64, 64), torch.nn.ReLU()]
        network = torch.nn.Sequential(*layers, torch.nn.Linear(64, 3), torch.nn.Sigmoid()).to(device)
        optimizer = torch.optim.Adam(network.parameters(), lr=1e-2)
        losses = []
        for _, batch in loader.batches(start=0, stop=steps):
            middle = batch.origins + batch.directions * (batch.near + batch.far) / 2
            rays = torch.cat([batch.origins, batch.viewdirs, middle], dim=-1)  # [n, 9]
            loss = ((network(rays) - batch.rgb) ** 2).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
    return losses


def main() -> None:
    """Train and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("shards", help="folder of the shards")
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--identities", type=int, default=4, help="per step, 8 views and 128 rays of each")
    arguments = parser.parse_args()
    losses = train(arguments.shards, arguments.steps, arguments.device, arguments.identities)
    for step in range(0, len(losses), max(1, len(losses) // 10)):
        print(f"step {step:5d}  loss {losses[step]:.5f}")
    print(f"step {len(losses) - 1:5d}  loss {losses[-1]:.5f}")


if __name__ == "__main__":
    main()
