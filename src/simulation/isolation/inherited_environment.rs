//! The environment of a simulation: only the variables of the server's environment that Webots and its controllers
//! need.

use std::ffi::OsString;

use crate::simulation::config::VariableName;

/// Variables that Webots, Qt, graphics drivers and interpreters read; with `*`, all with this prefix. None of them is a
/// secret of the server.
const NEEDED: &str = "PATH HOME USER LOGNAME SHELL TERM TZ LANG LANGUAGE LC_* TMPDIR XAUTHORITY XDG_RUNTIME_DIR \
                      XDG_DATA_DIRS XDG_CONFIG_DIRS WEBOTS_* LD_LIBRARY_PATH PYTHONPATH OMP_* QT_* QTWEBENGINE_* LIBGL_* \
                      MESA_* GALLIUM_* DRI_PRIME __GL* __NV* __EGL* VK_* VGL_* NVIDIA_* CUDA_*";

/// The variables of the server's own environment that a simulation gets.
pub fn allowed(more: &[VariableName]) -> Vec<(OsString, OsString)> {
    let needed = NEEDED.split_whitespace().filter_map(|name| VariableName::try_from(name.to_owned()).ok());
    let names: Vec<VariableName> = needed.chain(more.iter().cloned()).collect();
    std::env::vars_os()
        .filter(|(name, _)| name.to_str().is_some_and(|name| names.iter().any(|one| one.covers(name))))
        .collect()
}
