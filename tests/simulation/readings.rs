//! Readings of the machine and of its GPUs.

use std::path::Path;

use crate::support::{Builder, Client, Server, arm, demo_server, http, shared_library, until};

/// A folder with the stand-in for NVIDIA's library.
pub fn gpu_driver() -> tempfile::TempDir {
    shared_library("simulation/nvml.c", "libnvidia-ml.so.1")
}

fn with(library: &Path) -> Builder {
    demo_server(1).env("LD_LIBRARY_PATH", library.to_str().unwrap())
}

#[actix_rt::test]
async fn gpus_are_read_and_the_least_busy_one_counts() {
    let library = gpu_driver();
    let builder = with(library.path())
        .env("NVML_COMPUTE_0", "100")
        .env("NVML_COMPUTE_1", "99");
    let server = builder
        .set("displays", serde_json::json!([":90.0", ":90.1"]))
        .set("display", ":91")
        .start()
        .await;
    let status = async || server.status().await;
    until("GPUs are told", async || {
        status().await["gpus"].as_array().is_some_and(|gpus| gpus.len() == 2)
    })
    .await;
    let gpus = status().await["gpus"].clone();
    assert_eq!(
        (gpus[0]["name"].as_str(), gpus[0]["compute"].as_f64()),
        (Some("Stand-in A"), Some(100.0))
    );
    assert_eq!(
        (gpus[0]["memory"].as_f64(), gpus[1]["memory"].as_f64()),
        (Some(75.0), Some(12.5))
    );
    assert_eq!(gpus[0]["memoryTraffic"].as_f64(), Some(7.0));
    assert_eq!(gpus[0]["memoryTotal"].as_u64(), Some(8 << 30));
    let load = async || http::get(&server.url("/load")).await.text().parse::<f64>().unwrap();
    let metrics = async || server.metrics().await;
    // If other tests use all processors, the load is that of the processors.
    let is_full = async || metrics().await.contains("\nwebots_machine_cpu_percent 100\n");
    let counts = async || (99.0..100.0).contains(&load().await) || is_full().await;
    until("the mean is that of the less busy GPU", counts).await;
    let metrics = metrics().await;
    assert!(
        metrics.contains("webots_machine_gpu_compute_percent{gpu=\"0\",name=\"Stand-in A\"} 100"),
        "{metrics}"
    );
    // Simulations are spread over GPUs only if the configuration asks for it.
    let _client = Client::ready(&server).await;
    assert_eq!(given(&server).await, [(None, String::new(), ":91".to_owned())]);
}

/// The `gpuProblem` on `/status`.
async fn gpu_problem(server: &Server) -> Option<String> {
    server.status().await["gpuProblem"].as_str().map(str::to_owned)
}

#[actix_rt::test]
async fn gpus_that_are_lost_are_told_and_come_back() {
    let library = gpu_driver();
    let mark = library.path().join("mark");
    for (variable, words, left) in [
        ("NVML_LOST", "1 of 2 GPUs don't answer", 1),
        ("NVML_ONE", "1 of 2 GPUs don't answer", 1),
        // A driver that is loaded after the start and then unloaded.
        ("NVML_UNLOADED", "2 of 2 GPUs don't answer", 0),
    ] {
        let is_required = variable != "NVML_LOST";
        let builder = with(library.path())
            .env(variable, mark.to_str().unwrap())
            .set("requireGpu", is_required);
        if variable == "NVML_UNLOADED" {
            std::fs::write(&mark, "").unwrap();
        }
        let server = builder.start().await;
        if variable == "NVML_UNLOADED" {
            until("the driver is missed", async || {
                server.log().contains("no NVIDIA GPU is read")
            })
            .await;
            until("it is not ready", async || {
                server.health().await.1.contains("but sees none")
            })
            .await;
            std::fs::remove_file(&mark).unwrap();
        }
        let gpus = async || server.status().await["gpus"].as_array().unwrap().len();
        until("GPUs are told", async || gpus().await == 2).await;
        assert_eq!(gpu_problem(&server).await, None);
        until("it is ready", async || server.health().await.1 == "ok").await;
        std::fs::write(&mark, "").unwrap();
        until("they are lost", async || {
            gpu_problem(&server).await.is_some_and(|why| why.contains(words))
        })
        .await;
        assert_eq!(gpus().await, left);
        assert!(server.log().contains(words), "{}", server.log());
        assert!(server.metrics().await.contains("\nwebots_machine_gpu_lost 1\n"));
        let page = server.monitor().await.replace("&#39;", "'");
        assert!(page.contains(words), "{page}");
        let required = format!("(requireGpu), but {words}");
        let health = if is_required { required.as_str() } else { "ok" };
        until("its readiness is told", async || {
            server.health().await.1.contains(health)
        })
        .await;
        std::fs::remove_file(&mark).unwrap();
        until("they are back", async || {
            gpu_problem(&server).await.is_none() && gpus().await == 2
        })
        .await;
        assert!(server.log().contains("the GPUs answer again"), "{}", server.log());
        until("it is ready again", async || server.health().await.1 == "ok").await;
    }
}

#[actix_rt::test]
async fn a_driver_that_hangs_or_is_missing_holds_up_nothing() {
    let library = gpu_driver();
    for hang in ["init", "read", "no driver"] {
        let mut server = with(library.path()).env("NVML_HANG", hang).start().await;
        let csv = server.folder.join("log/simulation/monitor.csv");
        until("samples go on", async || {
            std::fs::read_to_string(&csv).is_ok_and(|text| text.lines().count() >= 4)
        })
        .await;
        Client::ready(&server).await;
        assert_eq!(server.status().await["gpus"], serde_json::json!([]));
        if hang == "no driver" {
            assert_eq!(server.log().matches("no NVIDIA GPU is read").count(), 1);
        }
        server.stops().await;
    }
}

#[actix_rt::test]
async fn samples_are_written_with_the_columns_of_the_original() {
    let server = demo_server(1).start().await;
    let _client = Client::ready(&server).await;
    let csv = server.folder.join("log/simulation/monitor.csv");
    let text = || std::fs::read_to_string(&csv).unwrap_or_default();
    until("an idle simulation is counted", async || {
        text().lines().skip(1).any(|line| line.contains(", 0, 1, "))
    })
    .await;
    let header = "Timestamp, Webots running, Webots idle, CPU load, CPU memory, GPU load compute, GPU load memory, \
                  GPU memory, Swap, Disk, Network sent, Network received";
    assert_eq!(text().lines().next(), Some(header));
    for line in text().lines().skip(1) {
        let values: Vec<f64> = line.split(", ").map(|value| value.parse().unwrap()).collect();
        assert_eq!(values.len(), 12, "{line}");
        assert!(
            values[0] > 1.0e9 && (0.0..=100.0).contains(&values[3]) && values[4] > 0.0,
            "{line}"
        );
    }
}

/// What each simulation gets: its GPU's number on `/status`, and its environment variables.
async fn given(server: &Server) -> Vec<(Option<u64>, String, String)> {
    let simulations = server.simulations().await;
    let told = simulations.iter().map(|one| {
        let pid = i32::try_from(one["pid"].as_i64().unwrap()).unwrap();
        let environment = procfs::process::Process::new(pid).unwrap().environ().unwrap();
        let variable = |name: &str| {
            let value = environment.get(std::ffi::OsStr::new(name));
            value
                .map(|value| value.to_str().unwrap().to_owned())
                .unwrap_or_default()
        };
        (
            one["gpu"].as_u64(),
            variable("CUDA_VISIBLE_DEVICES"),
            variable("DISPLAY"),
        )
    });
    told.collect()
}

#[actix_rt::test]
async fn simulations_are_spread_over_gpus_and_a_lost_one_gets_none() {
    let library = gpu_driver();
    let mark = library.path().join("mark");
    let displays = [":90.0", ":90.1", ":90.2", ":90.3"];
    let four = demo_server(12)
        .env("LD_LIBRARY_PATH", library.path().to_str().unwrap())
        .env("NVML_COUNT", "4")
        .env("NVML_COMPUTE_2", "95")
        .env("NVML_LOST", mark.to_str().unwrap())
        .env("NVML_LOST_INDEX", "1")
        .env("CUDA_VISIBLE_DEVICES", "0")
        .set("gpus", "spread")
        .set("displays", serde_json::json!(displays));
    let server = four.start().await;
    until("GPUs are read", async || server.status().await["gpus"][3].is_object()).await;
    // GPU 0 has the most memory in use, GPU 2 computes.
    let mut clients = Vec::new();
    for _ in 0..4 {
        clients.push(Client::start(&server, &arm()).await);
    }
    for client in &mut clients {
        client.until("webots:").await;
    }
    let expected = |gpus: &[usize]| {
        let one = |gpu: &usize| (Some(*gpu as u64), format!("GPU-{gpu}"), displays[*gpu].to_owned());
        gpus.iter().map(one).collect::<Vec<_>>()
    };
    let mut told = given(&server).await;
    told.sort();
    assert_eq!(told, expected(&[1, 1, 3, 3]));
    let page = server.monitor().await;
    assert!(
        page.contains("<small>GPU 3</small>") && page.contains("GPU 2: Stand-in C"),
        "{page}"
    );
    assert!(server.log().contains("it gets GPU 1, Stand-in B"), "{}", server.log());
    std::fs::write(&mark, "").unwrap();
    until("one is lost", async || gpu_problem(&server).await.is_some()).await;
    drop(clients);
    let simulations = async || server.status().await["simulations"].clone();
    until("all are gone", async || simulations().await == serde_json::json!([])).await;
    let mut clients = Vec::new();
    for _ in 0..3 {
        clients.push(Client::start(&server, &arm()).await);
        clients.last_mut().unwrap().until("webots:").await;
    }
    assert!(
        given(&server).await.iter().all(|(gpu, ..)| *gpu == Some(3)),
        "{:?}",
        given(&server).await
    );
    let metrics = server.metrics().await;
    assert!(
        metrics.contains("webots_machine_gpu_compute_percent{gpu=\"2\",name=\"Stand-in C\"} 95"),
        "{metrics}"
    );
}
