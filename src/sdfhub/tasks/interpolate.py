"""Task `interpolate`: the shapes on the way from one to another."""

from omegaconf import DictConfig

from sdfhub.opening import beside, load
from sdfhub.tasks.gallery import write_gallery


def interpolate(config: DictConfig) -> None:
    """The task: `config` as conf/interpolate.yaml has it."""
    space = load(config.run, trust=config.trust or ())
    codes = space.interpolate(config.a, config.b, config.steps)
    ends = [space.ids[space.row(shape)] for shape in (config.a, config.b)]
    shares = [index / (len(codes) - 1) for index in range(1, len(codes) - 1)]
    captions = [ends[0], *(f"{share:.2f}" for share in shares), ends[1]]
    name = "interpolate/" + "_to_".join(end.replace("/", "-") for end in ends)
    folder = beside(config.run, config.out, name)
    write_gallery(space, codes, captions, folder, config.resolution, animated=True)
