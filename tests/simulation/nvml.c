/* A stand-in for NVIDIA's management library: two GPUs, or NVML_COUNT of up to four, whose readings come from the environment. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

typedef struct { unsigned gpu, memory; } rates;
typedef struct { unsigned version; unsigned long long total, reserved, free, used; } memory;

static const char *at(const char *name) { const char *value = getenv(name); return value ? value : ""; }
/* Whether the file that a variable names is there. */
static int marked(const char *name) { return *at(name) && !access(at(name), F_OK); }
static long number(void *device) { return (long)device - 1; }
static void hang(const char *where) { if (!strcmp(at("NVML_HANG"), where)) for (;;) pause(); }

/* Once the driver was unloaded, nothing answers before the library is opened again. */
static int unloaded = 0;

int nvmlInit_v2(void) {
  hang("init");
  if (!strcmp(at("NVML_HANG"), "no driver") || marked("NVML_UNLOADED")) return 9;
  unloaded = 0;
  return 0;
}
int nvmlInitWithFlags(unsigned flags) { (void)flags; return nvmlInit_v2(); }
int nvmlShutdown(void) { return 0; }
int nvmlSystemGetDriverVersion(char *text, unsigned length) { strncpy(text, "550.54.15", length); return 0; }
int nvmlDeviceGetCount_v2(unsigned *count) { unloaded |= marked("NVML_UNLOADED"); *count = unloaded || marked("NVML_GONE") ? 0 : marked("NVML_ONE") ? 1 : *at("NVML_COUNT") ? (unsigned)atoi(at("NVML_COUNT")) : 2; return 0; }
int nvmlDeviceGetHandleByIndex_v2(unsigned index, void **device) { *device = (void *)(unsigned long)(index + 1); return 0; }
int nvmlDeviceGetUtilizationRates(void *device, rates *out) {
  hang("read");
  char compute[] = "NVML_COMPUTE_0";
  compute[sizeof compute - 2] += number(device);
  out->gpu = /* more than any processor */ marked("NVML_BUSY") ? 300 : atoi(at(compute));
  out->memory = 7;
  return 0;
}
int nvmlDeviceGetMemoryInfo_v2(void *device, memory *out) {
  if (number(device) == atoi(at("NVML_LOST_INDEX")) && marked("NVML_LOST")) return 15;
  out->total = 8ULL << 30;
  out->used = /* far beyond what readyLoad may be */ marked("NVML_FULL") ? 160ULL << 30 : device == (void *)1 ? 6ULL << 30 : 1ULL << 30;
  out->reserved = 0;
  out->free = out->total - out->used;
  return 0;
}
int nvmlDeviceGetName(void *device, char *text, unsigned length) { snprintf(text, length, "Stand-in %c", (char)('A' + number(device))); return 0; }
int nvmlDeviceGetUUID(void *device, char *text, unsigned length) { snprintf(text, length, "GPU-%ld", number(device)); return 0; }
const char *nvmlErrorString(int code) { (void)code; return "stand-in"; }
