//! The kinds of nodes that the demo simulator understands, and what of each it passes on to viewers.
//! Any other node of a world file is skipped whole.

/// A kind of node.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct Kind {
    /// The node's name in the world file and its tag in the model.
    pub(crate) name: &'static str,
    /// Fields that become attributes, with the attribute's name.
    pub(crate) attributes: &'static [(&'static str, &'static str)],
    /// Fields whose nodes become children.
    pub(crate) children: &'static [&'static str],
    /// Whether it has a place and can be moved or hidden.
    pub(crate) placed: bool,
}

const fn leaf(name: &'static str, attributes: &'static [(&'static str, &'static str)]) -> Kind {
    Kind { name, attributes, children: &[], placed: false }
}

const fn parent(name: &'static str, children: &'static [&'static str]) -> Kind {
    Kind { name, attributes: &[], children, placed: false }
}

const fn placed(name: &'static str) -> Kind {
    Kind { name, attributes: PLACE, children: CHILDREN, placed: true }
}

const CHILDREN: &[&str] = &["children"];
const PLACE: &[(&str, &str)] =
    &[("name", "name"), ("translation", "translation"), ("rotation", "rotation"), ("scale", "scale")];

const KINDS: &[Kind] = &[
    leaf(
        "WorldInfo",
        &[
            ("title", "title"),
            ("basicTimeStep", "basicTimeStep"),
            ("FPS", "FPS"),
            ("coordinateSystem", "coordinateSystem"),
        ],
    ),
    leaf(
        "Viewpoint",
        &[
            ("orientation", "orientation"),
            ("position", "position"),
            ("fieldOfView", "fieldOfView"),
            ("near", "zNear"),
            ("far", "zFar"),
            ("exposure", "exposure"),
            ("followSmoothness", "followSmoothness"),
        ],
    ),
    leaf("Background", &[("skyColor", "skyColor"), ("luminosity", "luminosity")]),
    leaf(
        "DirectionalLight",
        &[
            ("direction", "direction"),
            ("color", "color"),
            ("intensity", "intensity"),
            ("ambientIntensity", "ambientIntensity"),
            ("castShadows", "castShadows"),
            ("on", "on"),
        ],
    ),
    leaf(
        "PointLight",
        &[
            ("location", "location"),
            ("color", "color"),
            ("intensity", "intensity"),
            ("ambientIntensity", "ambientIntensity"),
            ("attenuation", "attenuation"),
            ("radius", "radius"),
            ("castShadows", "castShadows"),
            ("on", "on"),
        ],
    ),
    parent("Group", CHILDREN),
    placed("Pose"),
    placed("Transform"),
    placed("Solid"),
    placed(ROBOT),
    Kind {
        name: "Shape",
        attributes: &[("castShadows", "castShadows"), ("isPickable", "isPickable")],
        children: &["appearance", "geometry"],
        placed: false,
    },
    leaf(
        "PBRAppearance",
        &[
            ("baseColor", "baseColor"),
            ("transparency", "transparency"),
            ("roughness", "roughness"),
            ("metalness", "metalness"),
            ("emissiveColor", "emissiveColor"),
            ("emissiveIntensity", "emissiveIntensity"),
        ],
    ),
    parent("Appearance", &["material"]),
    leaf(
        "Material",
        &[
            ("ambientIntensity", "ambientIntensity"),
            ("diffuseColor", "diffuseColor"),
            ("emissiveColor", "emissiveColor"),
            ("shininess", "shininess"),
            ("specularColor", "specularColor"),
            ("transparency", "transparency"),
        ],
    ),
    leaf("Box", &[("size", "size")]),
    leaf("Sphere", &[("radius", "radius"), ("subdivision", "subdivision"), ("ico", "ico")]),
    leaf("Cylinder", ROUND),
    leaf("Cone", &[("bottomRadius", "bottomRadius"), ("height", "height"), ("subdivision", "subdivision")]),
    leaf("Capsule", ROUND),
    leaf("Plane", &[("size", "size")]),
];

const ROUND: &[(&str, &str)] =
    &[("radius", "radius"), ("height", "height"), ("subdivision", "subdivision"), ("top", "top"), ("bottom", "bottom")];

/// The kind whose nodes drive around.
pub(crate) const ROBOT: &str = "Robot";
/// The kind that holds the world's title and timing.
pub(crate) const WORLD_INFO: &str = "WorldInfo";
/// The kind without which no viewer shows anything.
pub(crate) const VIEWPOINT: &str = "Viewpoint";

/// The kind called `name`, if it is one of those understood.
pub(crate) fn find(name: &str) -> Option<&'static Kind> {
    KINDS.iter().find(|kind| kind.name == name)
}
