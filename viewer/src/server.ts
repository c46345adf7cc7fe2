// Data that the view server reads from files: JSON and bytes, with the token of the page.

export class Server {
  constructor(private readonly token: string) {}

  async get<T>(path: string, signal?: AbortSignal): Promise<T> {
    const reply = await fetch(path, {headers: {Authorization: `Bearer ${this.token}`}, signal});
    if (!reply.ok) throw new Error((await reply.text()).trim());
    return (await reply.json()) as T;
  }
}
