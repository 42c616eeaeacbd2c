from ._check import check_metric as check_metric
from ._family import Family as Family, family as family
from ._file import (
    document as document,
    from_recipe as from_recipe,
    recipe_text as recipe_text,
    servo_tables as servo_tables,
)
from ._load import (
    load as load,
    loaded_once as loaded_once,
    rebuild as rebuild,
    recipe as recipe,
    spec_name as spec_name,
)
from ._model_file import ModelError as ModelError, ModelFile as ModelFile
from ._rewrite import rewrite as rewrite
from ._robot_family import (
    RobotFamily as RobotFamily,
    robot_family as robot_family,
)
from ._source import attribute as attribute
from ._systems import check_spec as check_spec
from ._toml import Overrides as Overrides, override as override
