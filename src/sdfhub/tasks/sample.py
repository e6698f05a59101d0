"""Task `sample`: new shapes, drawn from a Gaussian fitted to the codes of the training shapes."""

from omegaconf import DictConfig

from sdfhub.opening import beside, load
from sdfhub.tasks.gallery import write_gallery


def sample(config: DictConfig) -> None:
    """The task: `config` as conf/sample.yaml has it."""
    space = load(config.run, trust=config.trust or ())
    codes = space.sample(config.n, config.seed)
    nearest = [space.neighbours(code, 1)[0] for code in codes]
    for index, (id, distance) in enumerate(nearest):
        print(f"{index:03d}  nearest training shape: {id} ({distance:.4f})")
    captions = [f"new\nnearest {id}" for id, _ in nearest]
    folder = beside(config.run, config.out, f"sample/seed_{config.seed}")
    write_gallery(space, codes, captions, folder, config.resolution)
