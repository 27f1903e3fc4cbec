/*
 * The decoder for C, as conformance/run.py asks it.
 *
 *     cc -O2 -I c -o build/cgs conformance/decoders/c.c -lm
 *     python conformance/run.py build/cgs
 */
#define COMPGS_IMPLEMENTATION
#include "compgs.h"

enum { FIELDS = 24, LINE = 1 << 16 };

static uint8_t *read_file(const char *path, size_t *size) {
    FILE *file = fopen(path, "rb");
    uint8_t *data = NULL;
    size_t room = 0, got = 1;
    *size = 0;
    while (file && got) {
        if (*size == room) data = (uint8_t *)realloc(data, room = 2 * room + 4096);
        if (!data) break;
        *size += got = fread(data + *size, 1, room - *size, file);
    }
    if (!file || ferror(file) || fclose(file) || !data) {
        fprintf(stderr, "%s cannot be read\n", path);
        exit(2);
    }
    return data;
}

static void write_file(const char *folder, const char *name, int number, const void *values, size_t size) {
    char path[4096];
    FILE *file;
    if (number < 0) snprintf(path, sizeof path, "%s/%s", folder, name);
    else snprintf(path, sizeof path, "%s/%s%d", folder, name, number);
    file = fopen(path, "wb");
    if (!file || fwrite(values, 1, size, file) != size || fclose(file)) {
        fprintf(stderr, "%s cannot be written\n", path);
        exit(2);
    }
}

static void write_heads(const cgs_scene *scene, const char *folder) {
    int32_t *all;
    size_t count = 0, at = 0, size;
    int i;
    for (i = 0; i < scene->tensors; i++) count += 1 + (size_t)scene->tensor[i].rows * scene->tensor[i].columns;
    all = (int32_t *)calloc(count, sizeof *all);
    if (!all) exit(2);
    for (i = 0; i < scene->tensors; i++) {
        size = (size_t)scene->tensor[i].rows * scene->tensor[i].columns;
        all[at++] = scene->tensor[i].exponent;
        memcpy(all + at, scene->tensor[i].values, size * sizeof *all);
        at += size;
    }
    write_file(folder, "heads", -1, all, count * sizeof *all);
    free(all);
}

/* Integers are written as the machine has them: it must be a little-endian one. */
static void write_arrays(const cgs_scene *scene, const char *folder) {
    const size_t anchors = scene->anchors, slots = (size_t)scene->coupled_primitives;
    int g;
    write_file(folder, "coordinates", -1, scene->coordinates, 3 * anchors * sizeof(int32_t));
    write_file(folder, "mask", -1, scene->mask, anchors * slots);
    write_heads(scene, folder);
    for (g = 0; g < scene->groups; g++) {
        const cgs_group *group = scene->group + g;
        const size_t channels = (size_t)group->channels, width = group->role == CGS_RESIDUAL ? slots * channels : channels;
        write_file(folder, "symbols", g, group->symbols, anchors * width * sizeof(int32_t));
        write_file(folder, "latents", g, group->latents, group->rows * channels * sizeof(int32_t));
    }
}

static void write_gaussians(const cgs_scene *scene, const char *folder, char **numbers) {
    double center[3];
    float *gaussians = (float *)malloc(((size_t)scene->coupled * CGS_GAUSSIAN + 1) * sizeof *gaussians);
    long count;
    int i;
    for (i = 0; i < 3; i++) center[i] = strtod(numbers[i], NULL);
    if (!gaussians || (count = cgs_predict(scene, center, gaussians)) < 0) exit(2);
    write_file(folder, "gaussians", -1, gaussians, (size_t)count * CGS_GAUSSIAN * sizeof *gaussians);
    free(gaussians);
}

static const char *answer(char **field, int count) {
    const int decodes = !strcmp(field[0], "decode"), predicts = !strcmp(field[0], "predict");
    const int is_prefix = decodes && count == 4;
    cgs_scene scene;
    cgs_error error;
    size_t size, given;
    uint8_t *data, *exact;
    if (!(decodes && count >= 3) && !(predicts && count == 6)) return "not offered";
    data = read_file(field[1], &size);
    given = is_prefix ? (size_t)strtoull(field[3], NULL, 10) : size;
    if (given > size) given = size;
    exact = (uint8_t *)malloc(given ? given : 1); /* so that a sanitizer sees each byte read behind the end */
    if (!exact) exit(2);
    memcpy(exact, data, given);
    free(data);
    error = cgs_decode(exact, given, is_prefix, &scene);
    free(exact);
    if (error != CGS_OK) return cgs_error_name(error);
    if (decodes) write_arrays(&scene, field[2]);
    else write_gaussians(&scene, field[2], field + 3);
    cgs_free(&scene);
    return "ok";
}

int main(void) {
    static char line[LINE];
    while (fgets(line, sizeof line, stdin)) {
        char *field[FIELDS], *at = line;
        int count = 0;
        line[strcspn(line, "\r\n")] = 0;
        while (at && count < FIELDS) {
            field[count++] = at;
            at = strchr(at, '\t');
            if (at) *at++ = 0;
        }
        puts(answer(field, count));
        fflush(stdout);
    }
    return 0;
}
